"""Plant and controller of a scene as C that compiles by itself."""
