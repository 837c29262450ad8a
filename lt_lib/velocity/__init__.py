"""From grid actions to velocity commands: navigators without a route head, and what their exploration reaches."""
