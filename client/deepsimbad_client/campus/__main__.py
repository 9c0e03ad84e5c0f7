"""`python -m deepsimbad_client.campus ROOT` renders a campus."""

from deepsimbad_client.campus.command import campus_command

campus_command()
