"""Active landmark-based self-localization as a service."""
