"""Configuration: defaults in code < YAML file < single values; reading and writing YAML."""
