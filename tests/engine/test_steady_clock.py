"""The sessions' clock: what the computer's clock does, and what sessions notice of it."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.engine.session_config import SessionConfig
from deepsimbad.engine.steady_clock import SteadyClock, boot_id, seconds_since_boot
from deepsimbad.errors import EndedSessionError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.session_records import SessionRecord
from deepsimbad.store.sessions import SessionStore

from .conftest import add_domain, add_map
from .live_service import TTL_S, Live, ranked, run

NOW = 1_790_000_000.0  # 2026
IN_1970 = 40.0


class Computer:
    """A computer whose clock can be set, and that can be rebooted."""

    def __init__(self, wall: float = NOW) -> None:
        self.wall = wall
        self.since_boot = 10.0
        self.boot = "first"

    def passes(self, seconds: float) -> None:
        self.wall += seconds
        self.since_boot += seconds

    def reboots(self, wall: float) -> None:
        self.wall, self.since_boot, self.boot = wall, 3.0, self.boot + "again"

    def clock(self, store: SessionStore) -> SteadyClock:
        past, latest = store.clock()
        clock = SteadyClock(
            past,
            latest,
            bool(store.living()),
            wall=lambda: self.wall,
            since_boot=lambda: self.since_boot,
            boot=self.boot,
        )
        store.note_clock(clock.record()).result()
        return clock


@pytest.fixture
def mapped(catalog: Catalog) -> Catalog:
    add_domain(catalog, "d")
    catalog.activate("d", add_map(catalog, "d"), None)
    return catalog


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SessionStore]:
    with SessionStore.open(tmp_path / "alone") as opened:
        yield opened


def keep_session(store: SessionStore, created_at: float) -> SessionRecord:
    new = SessionRecord(0, "s", "d", 1, "f" * 64, {}, created_at, created_at + TTL_S, 0, None)
    return store.create(new).result()


class Service:
    """Starts and stops of a service on such a computer, and one session in it."""

    def __init__(self, catalog: Catalog, computer: Computer) -> None:
        self.catalog = catalog
        self.computer = computer
        self.session_id = ""

    def starts(self, what: str) -> float:
        """Start, do one thing to the session, stop; the clock's time then."""
        with SessionStore.open(self.catalog.data_dir) as store:
            clock = self.computer.clock(store)

        async def body(live: Live) -> float:
            if what == "begin":
                self.session_id = (await live.sessions.begin(live.active_maps.active("d"), SessionConfig())).session_id
            elif what == "observe":
                await live.sessions.observe(self.session_id, ranked(1))
            await live.sessions.sweep()
            return clock()

        return run(self.catalog, body, clock)  # type: ignore[arg-type]

    def observed(self) -> None:
        self.starts("observe")


@pytest.mark.parametrize("jump_s", [-NOW + IN_1970, -3600.0, 3600.0, 1e9])
def test_a_clock_that_is_set_meanwhile_is_not_noticed(store: SessionStore, jump_s: float) -> None:
    computer = Computer()
    clock = computer.clock(store)
    assert clock() == NOW
    computer.wall += jump_s
    computer.passes(5)
    assert clock() == pytest.approx(NOW + 5)


def test_a_session_outlives_a_jump_across_a_restart_and_still_expires(mapped: Catalog) -> None:
    """Booted in 1970, told the time by the network, set back by a person: no reboot, so the time is known."""
    computer = Computer(IN_1970)
    service = Service(mapped, computer)
    service.starts("begin")
    for wall in (NOW, NOW - 1e6, IN_1970, NOW + 1e9):
        computer.passes(TTL_S - 1)
        computer.wall = wall
        service.observed()
    computer.passes(TTL_S + 1)
    computer.wall = IN_1970
    with pytest.raises(EndedSessionError, match="expired"):
        service.observed()


def test_a_reboot_into_1970_keeps_sessions_and_lets_them_expire(mapped: Catalog) -> None:
    computer = Computer()
    service = Service(mapped, computer)
    service.starts("begin")
    computer.passes(TTL_S - 1)
    began = service.starts("observe")
    computer.reboots(IN_1970)
    assert service.starts("observe") >= began
    computer.passes(TTL_S + 1)
    with pytest.raises(EndedSessionError, match="expired"):
        service.observed()


def test_sessions_of_a_clock_never_set_outlive_the_reboot_that_sets_it(mapped: Catalog) -> None:
    computer = Computer(IN_1970)
    service = Service(mapped, computer)
    service.starts("begin")
    computer.reboots(NOW)
    service.observed()
    computer.passes(TTL_S + 1)
    with pytest.raises(EndedSessionError, match="expired"):
        service.observed()
    assert service.starts("nothing") == computer.wall, "nothing lives: the time that is known now counts"


def test_time_that_the_computer_was_off_counts(mapped: Catalog) -> None:
    computer = Computer()
    service = Service(mapped, computer)
    service.starts("begin")
    computer.reboots(NOW + TTL_S / 2)
    service.observed()
    computer.reboots(NOW + 3 * TTL_S)
    with pytest.raises(EndedSessionError, match="expired"):
        service.observed()


def test_reboots_into_1970_do_not_keep_an_idle_session_for_ever(store: SessionStore) -> None:
    """What was noted between events is time that has passed."""
    computer = Computer(IN_1970)
    began = computer.clock(store)()
    keep_session(store, began)
    for _ in range(10):
        clock = computer.clock(store)
        computer.passes(TTL_S / 5)
        store.note_clock(clock.record()).result()
        computer.reboots(IN_1970)
    assert computer.clock(store)() == pytest.approx(began + 2 * TTL_S)


def test_a_file_that_never_noted_a_moment_goes_by_what_happened(store: SessionStore) -> None:
    """As an older release left it."""
    keep_session(store, NOW + 1000)
    assert store.clock() == (None, NOW + 1000)
    assert Computer(NOW).clock(store)() == NOW + 1000
    ended = store.find("s")
    store.end(ended.number, "deleted", NOW + 2000).result()
    computer = Computer(NOW)
    assert computer.clock(store)() == NOW + 2000


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("passes"), st.floats(0, 1e6)),
            st.tuples(st.sampled_from(["set", "reboot"]), st.floats(0, 4e9)),
        ),
        max_size=12,
    )
)
def test_it_never_goes_back(tmp_path_factory: pytest.TempPathFactory, happens: list[tuple[str, float]]) -> None:
    computer = Computer()
    with SessionStore.open(tmp_path_factory.mktemp("clock")) as store:
        keep_session(store, computer.clock(store)())
        latest = 0.0
        for what, value in happens:
            if what == "passes":
                computer.passes(value)
            elif what == "set":
                computer.wall = value
            else:
                computer.reboots(value)
            now = computer.clock(store)()
            assert now >= latest - 1e-3  # floats of 4e9 seconds
            latest = now


def test_the_computer_tells_its_boot_and_the_time_since() -> None:
    first = seconds_since_boot()
    assert 0 < first <= seconds_since_boot()
    assert boot_id() == boot_id()
    assert boot_id() is None or len(boot_id() or "") > 8


def test_a_start_notes_the_moment(store: SessionStore) -> None:
    clock = SteadyClock.of(store)
    noted, _ = store.clock()
    assert noted is not None
    assert noted.boot == boot_id()
    assert noted.seen_at <= clock()
