"""Everything durable: the catalog, traverses and map files. Every SQL statement of the service is here."""
