"""Client of the Deep SIMBAD service."""
