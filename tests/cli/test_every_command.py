"""What every command of `deepsimbad` has in common (design section 7)."""

from collections.abc import Iterator

import click
import pytest

from deepsimbad.cli import deepsimbad as root


def commands(group: click.Group, *before: str) -> Iterator[tuple[str, ...]]:
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from commands(command, *before, name)
        else:
            yield (*before, name)


@pytest.mark.parametrize("words", list(commands(root)), ids=" ".join)
def test_every_command_takes_a_data_directory(deepsimbad, words):
    told = deepsimbad(*words, "--data-dir", "some", "--help")
    assert told.code == 0, told.err
    assert "--data-dir" in told.out


def test_an_experiment_makes_no_data_directory(deepsimbad, tmp_path):
    given = ("--landmarks", "a.npy", "--training", "b.npy", "--test", "c.npy", "--data-dir", "some")
    ended = deepsimbad("experiment", "vpr", *given)
    assert ended.code == 1
    assert "a.npy" in ended.err
    assert not (tmp_path / "some").exists()
