"""The service on many machines, carried by Ray; nothing else imports Ray."""
