"""A map moved between servers: the same bytes, checked, or nothing."""

import hashlib
import sqlite3
from contextlib import closing

import numpy as np
import pytest

from deepsimbad.core.map import Map
from deepsimbad.engine.maps import Maps
from deepsimbad.errors import (
    ConflictError,
    DamagedMapError,
    DomainDiffersError,
    InvalidArchiveError,
    InvalidInputError,
    InvalidMapConfigError,
    NoActiveMapError,
    RetiredMapError,
    UnavailableError,
    UnknownMapVersionError,
)
from deepsimbad.jobs.versions import import_map, seal_version
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.map_file import export_map, seal, write_map
from deepsimbad.store.records import MapState
from deepsimbad.store.traverses import Traverse

EVALUATOR = {"kind": "feature_l2", "extractor": "none"}
ACTIONS_M = (1.0, 2.0)


def contents(domain, version, **changes):
    rng = np.random.default_rng(version)
    parts = {
        "config": {"relevance": "rrf", "n_landmarks": 9, "training_traverse": "summer", "landmark_traverse": "winter"},
        "evaluator": EVALUATOR,
        "closed": False,
        "actions_m": ACTIONS_M,
        "landmark_model": {"prototypes": rng.random((9, 4), dtype=np.float32)},
        "lists": np.argsort(rng.random((30, 9)), axis=1)[:, :3].T.astype(np.uint16).copy(),
        "position_m": np.arange(30.0),
        "metrics": {"anr": 4.5},
    }
    return Map(domain=domain, version=version, created_at="2026-01-01T00:00:00Z", **{**parts, **changes})


def add(catalog, domain, **changes):
    """Build, seal and activate the next version."""
    version = catalog.begin_map(domain, {})
    write_map(catalog.building_path(domain, version), contents(domain, version, **changes))
    digest, n_bytes = seal(catalog.building_path(domain, version), catalog.map_path(domain, version))
    catalog.seal_map(domain, version, digest, n_bytes, {})
    catalog.activate(domain, version, ANY)
    return version


@pytest.fixture
def exporter(tmp_path):
    """A server whose domain has two maps, the second active."""
    with Catalog.open(tmp_path / "there") as catalog:
        catalog.create_domain("campus", EVALUATOR, False, ACTIONS_M)
        add(catalog, "campus")
        add(catalog, "campus")
        yield catalog


@pytest.fixture
def importer(tmp_path):
    """A server with nothing on it."""
    with Catalog.open(tmp_path / "here") as catalog:
        yield catalog


@pytest.fixture
def exported(exporter, tmp_path):
    export_map(exporter, "campus", None, tmp_path / "campus.map")
    return tmp_path / "campus.map"


def test_the_bytes_travel_unchanged(exporter, importer, tmp_path):
    file = tmp_path / "first.map"
    sent_record = export_map(exporter, "campus", 1, file)
    assert file.read_bytes() == exporter.map_path("campus", 1).read_bytes()
    got = import_map(importer, file, "garden", f"sha256:{sent_record.sha256.upper()}")
    assert (got.domain, got.map_version, got.active, got.domain_is_new) == ("garden", 1, True, True)
    assert importer.map_path("garden", 1).read_bytes() == file.read_bytes()
    record = importer.map("garden", 1)
    assert (record.sha256, record.state, record.metrics["anr"]) == (sent_record.sha256, MapState.ACTIVE, 4.5)
    assert record.config["imported"] == {"domain": "campus", "version": 1, "sha256": sent_record.sha256}
    assert record.config["training_traverse"] is None, "a traverse of that name here is another drive"
    snapshot = Maps(importer).active("garden").snapshot
    assert (snapshot.domain, snapshot.version, snapshot.n_images) == ("garden", 1, 30)


def test_the_active_version_and_the_old_name_unless_told(exported, importer):
    assert import_map(importer, exported).domain == "campus"
    again = import_map(importer, exported, activate=False)
    assert (again.map_version, again.active, again.domain_is_new) == (2, False, False)
    assert importer.domain("campus").active_version == 1
    assert importer.map("campus", 2).state is MapState.SEALED
    assert importer.map("campus", 1).config["imported"]["version"] == 2


def test_a_map_that_makes_no_sense_is_neither_sealed_nor_served(importer):
    importer.create_domain("campus", EVALUATOR, False, ACTIONS_M)
    position_m = np.full(30, 4.0)
    with pytest.raises(InvalidMapConfigError, match="at one position"):
        seal_version(importer, "campus", contents("campus", 1, position_m=position_m), {}, {}, lambda _: None, None)
    assert importer.maps("campus") == []
    add(importer, "campus", position_m=position_m)  # as another machine could
    with pytest.raises(DamagedMapError):
        Maps(importer).active("campus")


def test_an_export_is_refused_by_name(exporter, tmp_path):
    exporter.create_domain("empty", {}, False, [1])
    building = exporter.begin_map("campus", {})
    exporter.remove_map("campus", 1, lambda: False)
    for domain, version, error in (
        ("empty", None, NoActiveMapError),
        ("campus", 9, UnknownMapVersionError),
        ("campus", building, UnknownMapVersionError),
        ("campus", 1, RetiredMapError),
    ):
        with pytest.raises(error):
            export_map(exporter, domain, version, tmp_path / "x")
    with pytest.raises(InvalidInputError, match="no folder"):
        export_map(exporter, "campus", 2, tmp_path / "no" / "x")
    (tmp_path / "mine").write_text("precious")
    with pytest.raises(ConflictError, match="never replaces"):
        export_map(exporter, "campus", 2, tmp_path / "mine")
    path = exporter.map_path("campus", 2)
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(DamagedMapError, match="map 2 of domain campus is damaged"):
        export_map(exporter, "campus", 2, tmp_path / "x")
    path.unlink()
    with pytest.raises(DamagedMapError, match="missing"):
        export_map(exporter, "campus", 2, tmp_path / "x")
    assert not (tmp_path / "x").exists()
    assert (tmp_path / "mine").read_text() == "precious"


@pytest.mark.parametrize(
    "parts",
    [
        ({"kind": "feature_l2", "extractor": "gradient_grid"}, False, ACTIONS_M),
        (EVALUATOR, True, ACTIONS_M),
        (EVALUATOR, False, (1.0, 3.0)),
    ],
)
def test_a_domain_that_differs_is_left_alone(exported, importer, parts):
    importer.create_domain("other", *parts)
    with pytest.raises(DomainDiffersError):
        import_map(importer, exported, "other")
    assert importer.maps("other") == []


def test_every_flipped_byte_that_matters_is_refused(exported, importer, tmp_path):
    """With the digest every byte matters; without it what is no map that makes sense is refused."""
    map_bytes = exported.read_bytes()
    digest = hashlib.sha256(map_bytes).hexdigest()
    bad = tmp_path / "bad.map"
    rng = np.random.default_rng(0)
    map_ = contents("campus", 2)
    for at in rng.integers(0, len(map_bytes), 30).tolist():
        bad.write_bytes(map_bytes[:at] + bytes([map_bytes[at] ^ (1 << rng.integers(8))]) + map_bytes[at + 1 :])
        with pytest.raises(InvalidArchiveError, match="another file"):
            import_map(importer, bad, sha256=digest)
    places = [map_bytes.index(map_.position_m[10:20].tobytes()) + 7, map_bytes.index(b"feature_l2") + 3, 3]
    for at in places:
        bad.write_bytes(map_bytes[:at] + bytes([map_bytes[at] ^ 2]) + map_bytes[at + 1 :])
        with pytest.raises(InvalidArchiveError, match="no map that can serve here"):
            import_map(importer, bad)
    for content in (b"", b"no map at all" * 400, map_bytes[: len(map_bytes) // 2]):
        bad.write_bytes(content)
        with pytest.raises(InvalidArchiveError):
            import_map(importer, bad)
    with pytest.raises(InvalidArchiveError, match="cannot be read"):
        import_map(importer, tmp_path / "gone")
    with pytest.raises(InvalidArchiveError, match="cannot be read"):
        import_map(importer, tmp_path)
    assert importer.domains() == []


def test_a_map_of_an_evaluator_that_is_not_here_is_refused(exporter, importer, tmp_path):
    exporter.create_domain("new", {"kind": "telepathy"}, False, ACTIONS_M)
    add(exporter, "new", evaluator={"kind": "telepathy"})
    export_map(exporter, "new", None, tmp_path / "new.map")
    with pytest.raises(InvalidArchiveError, match="no kind of evaluator"):
        import_map(importer, tmp_path / "new.map")
    export_map(exporter, "campus", None, tmp_path / "campus.map")
    with pytest.raises(InvalidInputError, match="a domain is named by"):
        import_map(importer, tmp_path / "campus.map", "../elsewhere")
    assert importer.domains() == []


@pytest.mark.parametrize("is_used", [False, True])
def test_an_import_that_fails_leaves_what_others_began_in_its_domain(exported, importer, monkeypatch, is_used):
    def fail(*_):
        if is_used:
            Traverse.create(importer.data_dir, "campus", "mine").close()
        raise UnavailableError("no space is left")

    monkeypatch.setattr("deepsimbad.jobs.versions.adopt", fail)
    with pytest.raises(UnavailableError):
        import_map(importer, exported)
    assert [record.name for record in importer.domains()] == (["campus"] if is_used else [])
    assert Traverse.list(importer.data_dir, "campus") == (["mine"] if is_used else [])


@pytest.mark.parametrize(
    "changes",
    [
        {"landmark_model": {"other": np.zeros((9, 4), np.float32)}},
        {"landmark_model": {"prototypes": np.zeros((8, 4), np.float32)}},
        {"landmark_model": {"prototypes": np.zeros((9, 0), np.float32)}},
        {"landmark_model": {"prototypes": np.full((9, 4), np.nan, np.float32)}},
        {"position_m": np.full(30, 5.0)},  # as all that tests/core/test_map.py lists
    ],
)
def test_a_map_that_could_answer_nothing_is_refused(importer, tmp_path, changes):
    """A file with a right digest may still be one that no release wrote."""
    write_map(tmp_path / "building", contents("campus", 1, **changes))
    seal(tmp_path / "building", tmp_path / "crafted.sqlite")
    with pytest.raises(InvalidArchiveError, match="no map that can serve here"):
        import_map(importer, tmp_path / "crafted.sqlite")
    assert importer.domains() == []


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE TRIGGER more AFTER INSERT ON map BEGIN SELECT 1; END",
        "CREATE VIEW endless AS WITH RECURSIVE c(n) AS (SELECT 0 UNION ALL SELECT n + 1 FROM c) SELECT n FROM c",
        "CREATE VIRTUAL TABLE texts USING fts5(body)",
    ],
)
def test_a_map_whose_schema_would_run_something_is_refused(exported, importer, statement):
    with closing(sqlite3.connect(exported)) as db:
        db.execute(statement)
    with pytest.raises(InvalidArchiveError, match="what no release writes"):
        import_map(importer, exported)
    assert importer.domains() == []
