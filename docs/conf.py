"""How `python -m lt_lib.report.site` builds the site: nothing is executed, and nothing loads from the network."""

project = "Latent Telepathy, reproduced"
author = "The Latent Telepathy compendium authors"
language = "en"
extensions = ["myst_nb"]
myst_heading_anchors = 3
nb_execution_mode = "off"
nb_mime_priority_overrides = [("html", "image/gif", 5)]
nb_code_prompt_show = "Show the code"
nb_code_prompt_hide = "Hide the code"
html_theme = "sphinx_book_theme"
html_title = project
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"home_page_in_toc": True, "show_toc_level": 2, "use_download_button": False}
html_context = {"default_mode": "auto"}
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
