"""From grid actions to velocity commands: navigators without a route, and what their exploration reaches."""
