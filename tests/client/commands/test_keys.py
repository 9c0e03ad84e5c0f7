"""A service that asks for keys, as the command line meets it."""

import pytest

from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope
from deepsimbad_client import Client, errors
from deepsimbad_client.commands import run

from ..conftest import serving


def test_a_refused_key_is_told_in_one_line_and_what_to_do(tmp_path, monkeypatch, capsys):
    with Catalog.open(tmp_path) as catalog:
        admin, robot = (catalog.create_key(scope)[1].text for scope in (KeyScope.ADMIN, KeyScope.LOCALIZE))
    with serving(tmp_path) as url:
        monkeypatch.setenv("DEEPSIMBAD_URL", url)
        for key, code in (("", "unauthorized"), (robot, "forbidden")):
            monkeypatch.setenv("DEEPSIMBAD_API_KEY", key)
            assert run(["jobs"]) == 1
            refused = capsys.readouterr().err
            assert refused.startswith(f"deepsimbad-client: {code}: ")
            assert "`deepsimbad keys create" in refused
            assert "$DEEPSIMBAD_API_KEY" in refused
            assert refused.count("\n") == 1
            assert robot not in refused
        assert run(["jobs", "--api-key", admin]) == 0
        with Client(url, robot) as client, pytest.raises(errors.ForbiddenError, match="--scope admin`") as forbidden:
            client.admin.sessions()
        assert forbidden.value.problem["needed"] == "admin"
