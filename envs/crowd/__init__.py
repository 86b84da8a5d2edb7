"""Play the games of a robot with several humans in highway-env."""
