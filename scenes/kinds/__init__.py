"""One module a kind of scene, found by its name: `Config` and `build`."""
