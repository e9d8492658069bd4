"""Other people's models, engines and controllers, made comparable."""
