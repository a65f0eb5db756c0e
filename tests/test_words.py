"""Names in the field's words: coined ones of earlier versions stay gone outside `follow/`, which has its own."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
COINED = re.compile(
    r"\b(Glimpse|glimpses?|Lookout|lookout|Sighting|sightings?|birdseye|laid_out|over_layouts|FreeRig|free_rig|RigTold|"
    r"RigFit|shared_rig|put_right|firmness|CudaCloud|cloud_cuda|orders_cuda|unweigh|Fleet|surveyors|VehicleRun|"
    r"EmptyScene|DetectedScene|as_seen|found_on|is_of|goes_on|ways?_of|strayed|Bends|card_of|on_card|showing_face|"
    r"Linker|find_course|unroll|LiveViews|kalman_wander|chase_film|chase_stage|chase_worlds|Wander|Shaking|Plant|"
    r"backdrops|speed_words|verdict_words|failures_told|telling_estimate|told_pictures|Guard|Imports)\b"
)


# What names a value is a noun or a quantity, not an adverb, a pronoun or a participle.
NO_NOUNS = re.compile(
    r"aside|few|here|there|how|mine|said|told|way|whole|these|many|most|often|everything|"
    r"nothing|wanted|asked|gone|away|apart|together|alike|alone|then|when|where|which|why|"
    r"off|begun|took|kept|seen|usual|worse|worst|better|sought|wish|wished|wishes"
)


def texts() -> dict[str, str]:
    """What is read by people or holds names, by its place in the project."""
    files = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    for place in ("src", "tests", "benchmarks", "examples", "docs"):
        files += [f for f in (ROOT / place).rglob("*") if f.suffix in (".py", ".md", ".j2", ".js", ".css")]
    found = {file.relative_to(ROOT).as_posix(): file.read_text(encoding="utf-8") for file in files}
    return {name: text for name, text in found.items() if "follow" not in name and not name.endswith("test_words.py")}


def constants(module: str) -> set[str]:
    """The names in capitals that a module binds at its top level."""
    nodes = [node for node in ast.parse(module).body if isinstance(node, ast.Assign | ast.AnnAssign)]
    names = [part for node in nodes for part in ast.walk(node) if isinstance(part, ast.Name)]
    return {part.id for part in names if isinstance(part.ctx, ast.Store) and re.fullmatch("[A-Z][A-Z0-9_]+", part.id)}


def test_coined_words_are_gone() -> None:
    assert {name: found for name, text in texts().items() if (found := set(COINED.findall(text)))} == {}


def test_a_constant_has_one_module() -> None:
    """A constant is a quantity, named with its unit where it has one; a second module imports it."""
    modules = defaultdict(list)
    for name, text in texts().items():
        if name.startswith("src/") and name.endswith(".py"):
            for word in constants(text):
                modules[word].append(name)
    assert {word: names for word, names in modules.items() if len(names) > 1} == {}


def local_names(module: str) -> set[str]:
    """The names of parameters and of variables in the functions of a module."""
    functions = [node for node in ast.walk(ast.parse(module)) if isinstance(node, ast.FunctionDef | ast.Lambda)]
    nodes = [node for function in functions for node in ast.walk(function)]
    stored = {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    return stored | {node.arg for node in nodes if isinstance(node, ast.arg)}


def test_values_are_named_by_nouns() -> None:
    modules = {name: text for name, text in texts().items() if name.startswith("src/") and name.endswith(".py")}
    assert {
        name: bad for name, text in modules.items() if (bad := set(filter(NO_NOUNS.fullmatch, local_names(text))))
    } == {}
