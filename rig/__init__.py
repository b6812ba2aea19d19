"""The application: config, plan, acquisition, reconstruction, command line."""
