// The theme's dark mode for the scoreboard's table, names for its fields, and the keyboard for tables that scroll.
const root = document.documentElement;
const follow = () => root.classList.toggle("dark", root.dataset.theme === "dark");
new MutationObserver(follow).observe(root, { attributes: true, attributeFilter: ["data-theme"] });
addEventListener("load", () => {
  follow();
  const name = () => {
    document.querySelectorAll("input[title]").forEach((field) => field.setAttribute("aria-label", field.title));
    document.querySelectorAll(".bd-article table").forEach((table) => table.setAttribute("tabindex", "0"));
  };
  name();
  new MutationObserver(name).observe(document.body, { childList: true, subtree: true });
});
