"""Plant and controller of a scene as functional mock-up units."""
