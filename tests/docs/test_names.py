"""Names can be searched: variables, parameters, fields and functions are called by the noun that they hold."""

import ast

import pytest

from .conftest import PROJECT

WORDS = set(
    """
    each one ones some both nothing something this that these those here there where then now what which who why how
    same most least more less few much own ours theirs mine others along apart beside elsewhere about within beyond
    until before after usual whole found known told kept made given taken asked seen done held said shown gone begun
    ended began came listed named built chosen wanted compared opened written sent added placed moved driven needed
    used mapped served
    """.split()  # noqa: SIM905
)
# What users of the client know them by, and keys of answers, of a map's measurements and of a file; datetime's own.
PUBLIC = {
    "client/deepsimbad_client/http/client.py": {"opened", "after"},
    "client/deepsimbad_client/http/models.py": {"ended", "others", "elsewhere"},
    "service/deepsimbad/api/whereabouts.py": {"others", "elsewhere"},
    "service/deepsimbad/core/drive.py": {"why"},
    "service/deepsimbad/evaluators/weights/lock.py": {"beside"},
    "service/deepsimbad/store/backup.py": {"what"},
    "tests/fleet/test_drives.py": {"now"},
    "tests/store/test_catalog.py": {"now"},
}


def names_in(tree):
    """(line, name) of all that is assigned or defined."""
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()) | ast.arg(arg=name):
                yield node.lineno, name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                yield node.lineno, name


@pytest.mark.parametrize("folder", ["service", "client", "migrations", "bench", "tests"])
def test_names_are_nouns_that_can_be_searched(folder):
    vague = []
    for path in sorted((PROJECT / folder).rglob("*.py")):
        file = str(path.relative_to(PROJECT))
        words = WORDS - PUBLIC.get(file, set())
        tree = ast.parse(path.read_text(encoding="utf-8"))
        vague += [f"{file}:{line}: {name}" for line, name in names_in(tree) if name.strip("_") in words]
    assert vague == []
