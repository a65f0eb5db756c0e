"""The house itself: rooms that keep their order, documents whose links and examples hold, one version."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
import yaml
from run_command import paceline as paceline_command

import paceline
from paceline.documents.loading import load_clip
from paceline.documents.models import ClipModel, PathModel, RigModel, UncertaintyModel, VehicleModel

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "paceline"
DOCUMENTS = [f for place in (ROOT, ROOT / "docs", ROOT / "benchmarks") for f in sorted(place.glob("*.md"))]
README = (ROOT / "README.md").read_text(encoding="utf-8")

# What a room may import beside itself, from the ground up. An inner room that is named has its own line.
GROUND = {
    "version", "arrays", "errors", "exit_status", "units", "number_format", "verdicts", "progress", "blas", "cameras",
    "subpixel", "sift_features", "numba_cache", "robust_line", "processor_cores",
}  # fmt: skip
BASE = GROUND | {"geometry", "recordings", "path_following"}
READ = BASE | {"documents"}
SEEN = READ | {"imaging"}
MADE = {
    "speed", "calibration", "targets", "follow", "lanes", "baselines", "verification", "detection", "simulation",
    "survey",
}  # fmt: skip
MAY_IMPORT = {
    **{room: GROUND for room in GROUND},
    "geometry": GROUND,
    "recordings": GROUND,
    "path_following": BASE,
    "documents": BASE,
    "imaging": READ,
    "speed": SEEN,
    "calibration": READ,
    "targets": READ,
    "follow": READ | {"targets"},
    "lanes": READ | {"speed"},
    "baselines": READ | {"speed"},
    "verification": READ | {"speed"},
    "detection": SEEN | {"lanes", "speed"},
    "simulation": READ,
    "simulation.closed_loop": READ | {"follow", "targets"},
    "simulation.boards": READ | {"calibration"},
    "survey": SEEN | {"detection", "lanes", "speed"},
    "survey.statistics": GROUND,
    "reports": SEEN | MADE,
    "console": READ
    | {"reports", "targets", "speed.geometry", "speed.configuration", "speed.choices", "speed.settings_table"},
    "commands": SEEN | MADE | {"reports", "console"},
    "api": SEEN | MADE,
    "cli": GROUND | {"commands"},
    "__main__": {"cli"},
}
# What parts of one room do not know of each other.
SIMULATORS = {"simulation.stereo", "simulation.chase", "simulation.raytraced", "simulation.closed_loop"}
NEVER = {
    "speed.geometry": {"speed.filter", "speed.refinement"},
    "speed.filter": {"speed.refinement"},
    "speed.refinement": {"speed.filter"},
    **{
        f"simulation.{shared}": SIMULATORS
        for shared in ("camera_errors", "operator", "road", "lane_change", "vehicle_catalogue", "textures", "video")
    },
    "simulation.stereo": SIMULATORS | {"simulation.random_scenes"},
    "simulation.chase": SIMULATORS | {"simulation.random_scenes"},
    "simulation.raytraced": SIMULATORS - {"simulation.chase"},
    "simulation.closed_loop": SIMULATORS - {"simulation.chase"},
    "survey.statistics": {"survey"},
    "reports.common": {f"reports.{product}" for product in ("speed", "live", "follow", "closed_loop")},
}


# --- rooms ---------------------------------------------------------------------------------------------------------


def modules() -> dict[str, ast.Module]:
    """Every module of the package below ``paceline`` itself, parsed."""
    found = {}
    for file in sorted(SOURCE.rglob("*.py")):
        parts = file.relative_to(SOURCE).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if name:
            found[name] = ast.parse(file.read_text(encoding="utf-8"))
    return found


MODULES = modules()


def imports(name: str) -> Iterator[str]:
    """Modules of the package that a module imports anywhere in it."""
    for node in ast.walk(MODULES[name]):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "paceline":
                    yield alias.name.removeprefix("paceline").lstrip(".")
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: expected absolute imports"
            if node.module is None or node.module.split(".")[0] != "paceline":
                continue
            inside = node.module.removeprefix("paceline").lstrip(".")
            for alias in node.names:
                full = f"{inside}.{alias.name}".lstrip(".")
                if full in MODULES:
                    yield full
                else:
                    yield inside


IMPORTS = {name: set(imports(name)) for name in MODULES}


def is_in(module: str, place: str) -> bool:
    return f"{module}.".startswith(f"{place}.")


def part_of(module: str, folder: str) -> str:
    """The file or folder directly in ``folder`` that ``module`` is or is in; empty where it is elsewhere."""
    inside = module.removeprefix(f"{folder}.") if folder else module
    return inside.split(".")[0] if not folder or inside != module else ""


FOLDERS = {""} | {name.rpartition(".")[0] for name in MODULES}


def test_every_room_is_in_the_table() -> None:
    rooms = {name.split(".")[0] for name in MODULES}
    assert rooms == {place for place in MAY_IMPORT if "." not in place}
    for place in {*MAY_IMPORT, *NEVER}.union(*MAY_IMPORT.values(), *NEVER.values()):
        assert place in MODULES, f"there is no {place}"


@pytest.mark.parametrize("name", MODULES)
def test_a_room_imports_only_what_it_may(name: str) -> None:
    place = max((place for place in MAY_IMPORT if is_in(name, place)), key=len)
    for other in IMPORTS[name]:
        assert other, f"{name} imports the API of the whole package"
        if part_of(other, "") != part_of(name, ""):
            assert any(is_in(other, allowed) for allowed in MAY_IMPORT[place]), f"{name} imports {other}"
        for own, others in NEVER.items():
            if is_in(name, own) and not is_in(other, own):
                assert not any(is_in(other, forbidden) for forbidden in others), f"{name} imports {other}"


def test_statistics_of_surveys_need_numpy_and_scipy_alone() -> None:
    nodes = [node for name, tree in MODULES.items() if is_in(name, "survey.statistics") for node in ast.walk(tree)]
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    packages = {name.split(".")[0] for name in names}
    assert packages - sys.stdlib_module_names == {"numpy", "scipy", "paceline"}


@pytest.mark.parametrize("folder", ["files", *sorted(FOLDERS)])
def test_there_are_no_circles(folder: str) -> None:
    """Neither of files, nor of what lies beside each other in a folder."""
    if folder == "files":
        # a package that gathers names from its own modules is no circle, unless they import it back
        graph = {name: others - {name} for name, others in IMPORTS.items()}
    else:
        graph = {part_of(name, folder): set() for name in MODULES}
        for name, others in IMPORTS.items():
            graph[part_of(name, folder)] |= {part_of(o, folder) for o in others} - {part_of(name, folder), ""}
        graph.pop("", None)
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " → ".join([*trail, name])
        if name not in done:
            for other in graph[name]:
                visit(other, (*trail, name))
            done.add(name)

    for name in graph:
        visit(name, ())


# --- the API -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", paceline.__all__)
def test_the_names_of_the_api_exist(name: str) -> None:
    assert getattr(paceline, name) is not None
    assert name in dir(paceline)


@pytest.mark.parametrize("document", [*DOCUMENTS, *sorted((ROOT / "examples").glob("*.py"))], ids=lambda p: p.name)
def test_examples_use_the_api_alone(document: Path) -> None:
    """Neither imports of inner modules nor names in them."""
    text = document.read_text(encoding="utf-8")
    assert not re.findall(r"(?:from|import) paceline\.[\w.]*", text)
    rooms = "|".join(sorted({name.split(".")[0] for name in MODULES} - {"follow"}))
    assert not re.findall(rf"\bpaceline\.(?:{rooms})\.\w+|\bpaceline\.follow\.\w+", text)


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'mesure'"):
        paceline.mesure  # noqa: B018


def test_importing_the_package_loads_nothing_else() -> None:
    code = "import sys; before = set(sys.modules); import paceline; print(*set(sys.modules) - before)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT / "src", capture_output=True, text=True, check=True)
    assert {m for m in done.stdout.split() if m.split(".")[0] not in sys.stdlib_module_names} == {
        "paceline",
        "paceline.version",
    }


# --- version -------------------------------------------------------------------------------------------------------


def test_there_is_one_version() -> None:
    assert metadata.version("paceline") == paceline.__version__
    headings = re.findall(r"^## \[(\d.*?)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings[0] == paceline.__version__


@pytest.mark.parametrize("name", ["requirements.txt", "requirements-dev.txt"])
def test_locks_hold_hashes_and_no_addresses(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    assert not re.search(r"://|--(index|extra|find|trusted)|^[./]", text, re.MULTILINE)
    pinned = re.findall(r"^\S+==.*\\\n    --hash=sha256:[0-9a-f]{64}", text, re.MULTILINE)
    assert len(pinned) == len(re.findall(r"^[a-z]", text, re.MULTILINE)) > 10


# --- documents -----------------------------------------------------------------------------------------------------


def anchors(document: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", document.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: p.name)
def test_links_lead_somewhere(document: Path) -> None:
    prose = re.sub(r"^```.*?^```", "", document.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", prose):
        if "://" in target:
            continue
        where, _, anchor = target.partition("#")
        file = document.parent / where if where else document
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


def blocks(language: str, document: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", document, re.MULTILINE | re.DOTALL)


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in that holds the examples."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("elsewhere", "unrendered_plots")
def test_the_readmes_session_is_what_the_command_prints() -> None:
    session = next(text for text in blocks("", README) if text.startswith("$ "))
    command, printed = session.removeprefix("$ .venv/bin/paceline ").split("\n", 1)
    done = paceline_command(*command.split())
    assert done.returncode == 0, done.stderr
    assert done.stdout == printed


@pytest.mark.slow
@pytest.mark.usefixtures("unrendered_plots")
def test_the_readme_measures_and_reports(elsewhere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(blocks("python", README)[0], "README.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    for line, name, truth in zip(lines, ("v0", "v1"), (45, 38), strict=True):
        found = re.fullmatch(rf"{name}: ([\d.]+) m/s, ([\d.]+) to ([\d.]+), measured ", line)
        assert found, line
        speed, low, high = map(float, found.groups())
        assert low < truth * 0.44704 < high
        assert speed == pytest.approx(truth * 0.44704, abs=0.15 * 0.44704)
    assert (elsewhere / "out" / "report.html").exists()


def test_the_readme_follows_a_stream(elsewhere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(blocks("python", README)[1], "README.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 14
    last = re.fullmatch(r"2\.6 s: ([\d.]+) ± [\d.]+ m/s, tracking", lines[-1])
    assert last and float(last[1]) == pytest.approx(45 * 0.44704, abs=0.44704)


def test_the_readmes_clip_can_be_read(tmp_path: Path) -> None:
    (tmp_path / "clip.yaml").write_text(blocks("yaml", README)[0], encoding="utf-8")
    (tmp_path / "rig.yaml").symlink_to(ROOT / "examples" / "straight" / "rig.yaml")
    assert [v.id for v in load_clip(tmp_path / "clip.yaml").vehicles] == ["v0"]


def test_every_key_is_documented() -> None:
    text = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    RigModel.model_validate(yaml.safe_load(blocks("yaml", text)[0]))
    for model in (RigModel, UncertaintyModel, ClipModel, PathModel, VehicleModel):
        for key in model.model_fields:
            assert re.search(rf"^\| [^|]*`{key}`", text, re.MULTILINE), f"{model.__name__}: {key}"


def test_every_column_is_documented() -> None:
    from paceline.reports.speed.tables import ESTIMATE_COLUMNS

    text = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    for column in ESTIMATE_COLUMNS:
        side = re.fullmatch(r"(left|right)_[xy]\d", column)
        assert f"`{side[1]}_x1` … `{side[1]}_y4`" in text if side else f"`{column}`" in text, column
