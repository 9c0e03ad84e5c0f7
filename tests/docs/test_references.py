"""What the pages name is there: targets, calls, settings, options, modules, files, links; and figures agree."""

import importlib.util
import re
import shlex
import tomllib
from functools import cache

import click
import pytest
from click.testing import CliRunner

from deepsimbad.api.app import create_app
from deepsimbad.cli import deepsimbad
from deepsimbad.cli.serve import setting_text
from deepsimbad.settings import CONFIG_VARIABLE, Settings, trace_settings, variable_of
from deepsimbad_client.commands import cli as deepsimbad_client
from deepsimbad_client.http.wire import KEY_VARIABLE, URL_VARIABLE

from .conftest import PROJECT, Page

METHODS = "GET|POST|PUT|DELETE"
OTHER_VARIABLES = {URL_VARIABLE, KEY_VARIABLE, CONFIG_VARIABLE, "DEEPSIMBAD_REAL_DATA", "DEEPSIMBAD_SITE"}
OTHER_VARIABLES |= {"DEEPSIMBAD_COMPLETE", "DEEPSIMBAD_CLIENT_COMPLETE"}  # click's own


def settings_by_variable():
    return {variable_of(name): field for name, field in Settings.model_fields.items()}


SETTINGS_PAGE = Page(PROJECT / "docs" / "settings.md")


@pytest.fixture(scope="module")
def calls(tmp_path_factory):
    """(method, path with {} for every name) of everything the OpenAPI document lists."""
    document = create_app(Settings(data_dir=tmp_path_factory.mktemp("none"))).openapi()
    return {(method.upper(), unnamed(path)) for path, methods in document["paths"].items() for method in methods}


def unnamed(path):
    return re.sub(r"\{[^}]*\}", "{}", path)


def test_every_make_target_named_is_there(pages):
    targets = set(re.findall(r"^([a-z]+):", (PROJECT / "Makefile").read_text(), re.MULTILINE))
    mentioned_targets = {word for page in pages for word in re.findall(r"\bmake ([a-z]+)", "\n".join(page.commands()))}
    assert mentioned_targets >= {"demo", "test", "bench", "help"}
    assert mentioned_targets <= targets


def test_every_call_named_is_served_and_every_call_is_in_the_table(pages, calls):
    mentioned_calls = {
        (method, unnamed(path))
        for page in pages
        for method, path in re.findall(rf"\b({METHODS}) (/[\w./{{}}-]*)", page.text)
    }
    assert mentioned_calls <= calls, f"not served: {sorted(mentioned_calls - calls)}"
    text = (PROJECT / "docs" / "http.md").read_text()
    described = {(method, unnamed(path)) for method, path in re.findall(rf"`({METHODS}) (/[^`]*)`", text)}
    assert calls <= described, f"not described: {sorted(calls - described)}"


def test_every_variable_named_is_a_setting_and_every_setting_is_named(pages):
    variables = {word for page in pages for word in re.findall(r"DEEPSIMBAD_[A-Z_]+", page.text)}
    assert variables == set(settings_by_variable()) | OTHER_VARIABLES
    assert set(settings_by_variable()) <= set(
        re.findall(r"^\| `(DEEPSIMBAD_[A-Z_]+)`", SETTINGS_PAGE.text, re.MULTILINE)
    )


@pytest.mark.parametrize("variable", sorted(settings_by_variable()))
def test_the_table_of_settings_tells_default_and_meaning(variable):
    field = settings_by_variable()[variable]
    (row,) = [line for line in SETTINGS_PAGE.text.splitlines() if line.startswith(f"| `{variable}`")]
    _, _, default, meaning, _ = (cell.strip() for cell in row.split("|"))
    assert default == f"`{setting_text(field.default)}`"
    assert meaning == field.description


def test_the_settings_file_shown_is_one(tmp_path):
    (example,) = SETTINGS_PAGE.blocks("toml")
    (tmp_path / "shown.toml").write_text(example)
    settings = trace_settings(tmp_path / "shown.toml").settings
    assert settings.keep_maps == tomllib.loads(example)["keep_maps"]


@cache
def help_of(program, *command):
    group = {"deepsimbad": deepsimbad, "deepsimbad-client": deepsimbad_client}[program]
    result = CliRunner().invoke(group, [*command, "--help"])
    assert result.exit_code == 0, f"{program} has no command {' '.join(command)}"
    return result.output


def test_every_command_named_exists_and_has_the_options_shown(pages):
    n_options = 0
    for page in pages:
        for text in page.commands():
            words = shlex.split(text) if re.match(r"deepsimbad(-client)? [a-z]", text) else []
            if not words:
                continue
            depth = 3 if words[1] in {"experiment", "keys", "weights"} else 2
            help_text = help_of(words[0], *words[1:depth])
            for option in (word for word in words if word.startswith("--")):
                assert re.search(rf"{option}\b", help_text), f"{page.path.name}: {text}: no option {option}"
                n_options += 1
    assert n_options > 20


def help_texts(command):
    """Every option of a command and of those below it, with what its help says; and what lists say of the command."""
    for below in getattr(command, "list_commands", lambda _: ())(click.Context(command)):
        yield from help_texts(command.get_command(click.Context(command), below))
    yield command.name, command.get_short_help_str(200)
    yield from ((f"{command.name} {it.opts[0]}", it.help) for it in command.params if isinstance(it, click.Option))


def test_every_option_says_what_it_is_for():
    for name, text in (*help_texts(deepsimbad), *help_texts(deepsimbad_client)):
        assert text, f"{name} says nothing"
        assert not re.search(r"\b[A-Z][a-z]{1,2}\.$", text), f"{name} is cut off behind an abbreviation: {text}"


def test_every_module_extra_link_and_file_named_is_there(pages):
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    commands = [text for page in pages for text in page.commands()]
    modules = {module for text in commands for module in re.findall(r"python -m ([\w.]+)", text)}
    assert {"bench.nordland", "bench.orders"} <= modules
    assert [module for module in modules if importlib.util.find_spec(module) is None] == []
    extras = {extra for text in commands for extra in re.findall(r"'\.\[(\w+)\]'", text)}
    assert {"service", "replay"} <= extras <= set(project["optional-dependencies"])
    files = []
    for page in pages:
        links = [link for link in re.findall(r"\]\(([^)#]+)\)", page.prose) if not re.match(r"https?://", link)]
        paths = re.findall(r"\b((?:service|client|migrations|tests|bench|docs)/[\w./-]+)", page.text)
        files += [(page.path.name, page.path.parent / link) for link in links]
        files += [(page.path.name, PROJECT / path.rstrip(".")) for path in paths]
    assert len(files) > 25
    assert [(page, path) for page, path in files if not path.exists()] == []


def test_the_figures_shown_are_the_measured_ones(readme):
    result_lines = (PROJECT / "docs" / "results" / "composed.md").read_text().splitlines()
    rows = r"^\| (?:composed|standardised|rrf|brute_force|brute_force_u) \|.*$"
    table = re.findall(rows, (PROJECT / "docs" / "methods.md").read_text(), re.MULTILINE)
    assert len(table) == 5
    assert [row for row in table if row not in result_lines] == []
    assert "docs/results/composed.md" in readme.prose
    assert re.findall(r"\d\.\d+ %", readme.text) == [], "figures of accuracy stand in the results"


def test_every_decision_has_a_number_of_its_own_and_its_parts_and_pictures_are_few_and_small():
    records = sorted((PROJECT / "docs" / "decisions").glob("*.md"))
    assert len({int(path.name[:4]) for path in records}) == len(records) >= 6
    for path in records:
        text = path.read_text()
        assert text.startswith(f"# {path.name[:4]} ")
        parts = re.findall(r"^## (\w+)", text, re.MULTILINE)
        assert parts[0] == "Context", path.name
        assert "Decision" in parts, path.name
        assert len(parts) >= 3, f"{path.name} says nothing of what follows"
    assert sum(path.stat().st_size for path in (PROJECT / "docs" / "images").iterdir()) < 400_000
