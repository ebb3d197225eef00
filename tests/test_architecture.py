"""The plan of the house, checked by reading every module's syntax tree: who may import whom, and what no module may do.

Each rule is a function of (file name, source) that returns the faults it found; beside it stand samples it must reject and one that
it must let pass.
"""

import ast
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
# Lowest first: a module of core imports only from its own folder and from those to its left.
LAYERS = (
    "foundation geometry images matching body motion networks take results surface calibration synthetic tracking fitting checking "
    "synchronising report run cli"
).split()
THIRD_PARTY = {"numpy", "scipy", "cv2", "threadpoolctl"}
OPTIONAL = {
    name: {"dask", "distributed"} for name in ("core/run/batch.py", "core/run/engine.py")
}  # the extra [batch]; imported only when it is used
NETWORK = {"socket", "ssl", "http", "urllib", "ftplib", "smtplib", "xmlrpc", "requests", "asyncio"}
SERIALIZERS = {"pickle", "cPickle", "_pickle", "marshal", "shelve", "dill", "joblib"}
LONGEST_FILE = 450
CONTAINERS = set("list dict set deque defaultdict OrderedDict Counter".split())
CHANGING = set("append appendleft extend insert remove pop popleft popitem clear add discard update setdefault".split())

OPENING = {"open", "read_text", "read_bytes", "fromfile", "loadtxt", "imread", "iterparse"}
PARSING = {"json.load", "json.loads", "np.load", "Xml.parse", "Xml.fromstring", "ElementTree.parse", "ElementTree.fromstring"}
OWN = {  # an operator's argument; a file that was opened there; what is written, and where unwanted output goes
    "json.loads": ("addon/correcting/operators.py",),
    "np.load": ("core/foundation/store.py",),
    "os.open": ("core/foundation/lock.py", "core/foundation/store.py", "core/cli/arguments.py", "core/cli/streams.py"),
}

Imported = tuple[int, bool, tuple[str, ...]]  # line, relative or not, the module's dotted name (relative ones from the root)


@cache
def tree_of(source: str) -> ast.Module:
    """The syntax tree of a module; each is asked for by several rules."""
    return ast.parse(source)


@cache
def nodes_of(source: str) -> tuple[ast.AST, ...]:
    """All nodes of that tree."""
    return tuple(ast.walk(tree_of(source)))


def imported(name: str, source: str) -> Iterator[Imported]:
    """Every import of a module, at its head or inside a function."""
    package = Path(name).parent.parts
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, False, tuple(alias.name.split("."))
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = (*base, *(node.module.split(".") if node.module else ()))
            for alias in node.names:
                yield node.lineno, bool(node.level), (*module, alias.name)


def calls(source: str) -> Iterator[tuple[int, str]]:
    """Every call by name: line and the dotted name that is called, e.g. "np.load"."""
    for node in nodes_of(source):
        if isinstance(node, ast.Call):
            yield node.lineno, ast.unparse(node.func)


def layer_order(name: str, source: str) -> list[str]:
    """Every module of core lies in a folder and imports only from its left; synthetic is for the commands alone; core knows no add-on."""
    if not name.startswith("core/") or name == "core/__init__.py":
        return []
    folder = Path(name).parts[1]
    if folder not in LAYERS:
        return [f"{name}: “{folder}” has no place in the layer order; put the module into a folder, and the folder into LAYERS"]
    allowed = {*LAYERS[: LAYERS.index(folder) + 1]} - ({"synthetic"} - {folder} if folder != "cli" else set())
    return [
        f"{name}:{line} imports {'.'.join(module)}, which is not below {folder}"
        for line, relative, module in imported(name, source)
        if relative and (module[0] != "core" or module[1] not in allowed)
    ]


def core_is_pure(name: str, source: str) -> list[str]:
    """Core uses the standard library and THIRD_PARTY: no bpy, no mathutils; Dask in one place, which loads without it."""
    known = THIRD_PARTY | set(sys.stdlib_module_names)
    head = {alias.name.split(".")[0] for node in tree_of(source).body if isinstance(node, ast.Import) for alias in node.names}
    head |= {str(node.module).split(".")[0] for node in tree_of(source).body if isinstance(node, ast.ImportFrom) and not node.level}
    known |= OPTIONAL.get(name, set()) - head
    return [
        f"{name}:{line} imports {module[0]}"
        for line, relative, module in imported(name, source)
        if name.startswith("core/") and not relative and module[0] not in known
    ]


def bpy_stays_in_the_addon(name: str, source: str) -> list[str]:
    """The root modules load without Blender: at their head stands no import of bpy or of the add-on."""
    if "/" in name:
        return []
    head = "\n".join(ast.unparse(node) for node in ast.parse(source).body if isinstance(node, (ast.Import, ast.ImportFrom)))
    return [f"{name} imports {'.'.join(module)} at its head" for _, _, module in imported(name, head) if module[0] in ("bpy", "addon")]


def imports_are_relative(name: str, source: str) -> list[str]:
    """In Blender the package is not called `tricap`, so modules of ours are imported relatively only."""
    return [
        f"{name}:{line} imports {'.'.join(module)} by an absolute name"
        for line, relative, module in imported(name, source)
        if not relative and module[0] in ("tricap", "core", "addon", "bl_ext", "tests")
    ]


def core_does_not_print(name: str, source: str) -> list[str]:
    """Only a command's own output is printed."""
    if not name.startswith("core/") or name.startswith("core/cli/"):
        return []
    printing = ("print", "sys.stdout.write", "sys.stderr.write")
    return [f"{name}:{line} calls {called}" for line, called in calls(source) if called in printing]


def files_carry_no_code(name: str, source: str) -> list[str]:
    """A file from a stranger cannot run code: no pickle, no eval."""
    faults = [f"{name}:{line} imports {module[0]}" for line, _, module in imported(name, source) if module[0] in SERIALIZERS]
    faults += [f"{name}:{line} calls {called}" for line, called in calls(source) if called in ("eval", "exec", "__import__")]
    allowed = [node.value for node in nodes_of(source) if isinstance(node, ast.keyword) and node.arg == "allow_pickle"]
    return faults + [
        f"{name}:{value.lineno} allows pickle" for value in allowed if not (isinstance(value, ast.Constant) and value.value is False)
    ]


def files_are_opened_in_one_place(name: str, source: str) -> list[str]:
    """Files from outside are opened and parsed by core/foundation/bounded.py, which refuses what is no file, too large or too deep."""
    if name == "core/foundation/bounded.py":
        return []
    faults = [f"{name}:{line} imports {module[0]}" for line, _, module in imported(name, source) if module[0] == "tomllib"]
    return faults + [
        f"{name}:{line} calls {called}"
        for line, called in calls(source)
        if (called in PARSING or called.rpartition(".")[2] in OPENING) and name not in OWN.get(called, ())
    ]


def links_may_lead_in_a_circle(name: str, source: str) -> list[str]:
    """Path.resolve raises RuntimeError there before Python 3.13; bounded.real_path does not."""
    return [f"{name}:{line} calls {called}" for line, called in calls(source) if called.endswith(".resolve") and "__file__" not in called]


def patterns_are_matched_in_one_place(name: str, source: str) -> list[str]:
    """Patterns from outside are matched by bounded.matching: links in circles have no end of names for `Path.glob`."""
    return [
        f"{name}:{node.lineno} matches a pattern that is no literal"
        for node in nodes_of(source)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ("glob", "rglob", "iglob")
        if name != "core/foundation/bounded.py" and not isinstance(node.args[-1], (ast.Constant, ast.JoinedStr))
    ]


def no_network(name: str, source: str) -> list[str]:
    """Nothing leaves the computer."""
    absolute = [(line, module[0]) for line, relative, module in imported(name, source) if not relative]
    return [f"{name}:{line} imports {module}" for line, module in absolute if module in NETWORK]


def no_silent_except(name: str, source: str) -> list[str]:
    """An error is mended, told or passed on; it does not vanish."""
    return [
        f"{name}:{node.lineno} swallows {'everything' if node.type is None else ast.unparse(node.type)}"
        for node in nodes_of(source)
        if isinstance(node, ast.ExceptHandler) and (node.type is None or all(isinstance(part, ast.Pass) for part in node.body))
    ]


def state_is_in_the_session(name: str, source: str) -> list[str]:
    """The add-on's state is in addon/session.py: elsewhere a module has constants, which are named in capitals and never changed."""
    if not name.startswith("addon/") or name == "addon/session.py":
        return []
    tree = tree_of(source)
    bodies = [("", tree.body), *((f"{node.name}.", node.body) for node in tree.body if isinstance(node, ast.ClassDef))]
    bound = [
        (line, f"{owner}{target}") for owner, body in bodies for line, target in containers(body) if not target.startswith(("bl_", "__"))
    ]
    changed = [(line, target) for line, target in changes(tree) if in_capitals(target)]
    changed += [(node.lineno, ", ".join(node.names)) for node in ast.walk(tree) if isinstance(node, ast.Global)]
    return [f"{name}:{line} has state of its own: {target}" for line, target in bound + changed]


def in_capitals(dotted: str) -> bool:
    """Whether the last part of a dotted name is that of a constant."""
    last = dotted.rpartition(".")[2].lstrip("_")
    return last.isidentifier() and last.isupper()


def containers(body: list[ast.stmt]) -> Iterator[tuple[int, str]]:
    """Lists, dicts and sets bound by these statements that can only be meant to change: empty ones, and those not named in capitals."""
    shown = (ast.List, ast.Dict, ast.Set, ast.ListComp, ast.DictComp, ast.SetComp)
    for node in body:
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
            called = ast.unparse(node.value.func).rpartition(".")[2] if isinstance(node.value, ast.Call) else ""
            empty = ast.unparse(node.value) in ("[]", "{}", f"{called}()")
            if isinstance(node.value, shown) or called in CONTAINERS:
                targets = [ast.unparse(target) for target in (node.targets if isinstance(node, ast.Assign) else [node.target])]
                yield from ((node.lineno, target) for target in targets if empty or not in_capitals(target))


def changes(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """What is changed in place, by line: "jobs.ENDED" of `jobs.ENDED.append(f)`, of `jobs.ENDED[:] = []` and of `jobs.ENDED += [f]`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in CHANGING:
            yield node.lineno, ast.unparse(node.func.value)
        if isinstance(node, ast.Subscript) and not isinstance(node.ctx, ast.Load):
            yield node.lineno, ast.unparse(node.value)
        if isinstance(node, ast.AugAssign):
            yield node.lineno, ast.unparse(node.target)


def scipy_is_imported_where_it_is_used(name: str, source: str) -> list[str]:
    """scipy takes half a second to import: functions import it, so that the command answers and the add-on is enabled without it."""
    heads = [node for node in ast.parse(source).body if isinstance(node, (ast.Import, ast.ImportFrom))]
    modules = [(node.lineno, getattr(node, "module", None) or node.names[0].name) for node in heads if not getattr(node, "level", 0)]
    return [f"{name}:{line} imports {module} at its head" for line, module in modules if module.split(".")[0] == "scipy"]


def files_stay_small(name: str, source: str) -> list[str]:
    """A file that outgrows 450 lines holds two subjects."""
    length = len(source.splitlines())
    return [f"{name} has {length} lines, more than {LONGEST_FILE}"] if length > LONGEST_FILE else []


Rule = Callable[[str, str], list[str]]
REJECTED: list[tuple[Rule, str, str]] = [
    (layer_order, "core/geometry/camera.py", "from ..matching.seeds import grow"),
    (layer_order, "core/foundation/errors.py", "from ..take import take"),
    (layer_order, "core/body/skin/contour_skin.py", "def f():\n    from ...fitting.solve import solver"),
    (layer_order, "core/run/pipeline.py", "from ..synthetic.arm import make_arm_take"),
    (layer_order, "core/synthetic/arm.py", "from ..run.pipeline import run"),
    (layer_order, "core/take/take.py", "from ...addon import jobs"),
    (layer_order, "core/helpers.py", ""),
    (layer_order, "core/helpers/text.py", ""),
    (core_is_pure, "core/body/skin/contour_skin.py", "import bpy"),
    (core_is_pure, "core/body/skin/contour_skin.py", "from mathutils import Vector"),
    (core_is_pure, "core/report/pages.py", "def draw():\n    import matplotlib.pyplot"),
    (core_is_pure, "core/run/pipeline.py", "def f():\n    from distributed import Client"),
    (core_is_pure, "core/run/batch.py", "from distributed import Client"),
    (bpy_stays_in_the_addon, "__init__.py", "import bpy"),
    (bpy_stays_in_the_addon, "__init__.py", "from . import addon"),
    (imports_are_relative, "core/take/take.py", "from tricap.core.foundation.errors import InputError"),
    (imports_are_relative, "addon/jobs.py", "import core.run.pipeline"),
    (core_does_not_print, "core/surface/cloud.py", "print('done')"),
    (core_does_not_print, "core/surface/cloud.py", "import sys\nsys.stdout.write('done')"),
    (files_carry_no_code, "core/foundation/store.py", "import pickle"),
    (files_carry_no_code, "core/foundation/store.py", "from pickle import loads"),
    (files_carry_no_code, "addon/presets.py", "eval(text)"),
    (files_carry_no_code, "core/foundation/store.py", "np.load(path, allow_pickle=True)"),
    (files_are_opened_in_one_place, "core/take/take.py", "text = path.read_text()"),
    (files_are_opened_in_one_place, "core/take/take.py", "with open(path) as file:\n    file.read()"),
    (files_are_opened_in_one_place, "core/take/take.py", "with Path(path).open() as file:\n    file.read()"),
    (files_are_opened_in_one_place, "core/take/take.py", "import tomllib"),
    (files_are_opened_in_one_place, "addon/presets.py", "import json\ntable = json.loads(text)"),
    (files_are_opened_in_one_place, "core/images/sequence.py", "image = cv2.imread(str(path))"),
    (files_are_opened_in_one_place, "core/take/take.py", "data = np.load(path, allow_pickle=False)"),
    (links_may_lead_in_a_circle, "core/take/take.py", "where = Path(folder).resolve()"),
    (patterns_are_matched_in_one_place, "core/take/take.py", "paths = sorted(folder.glob(take.views[0].images))"),
    (no_network, "core/cli/main.py", "from urllib.request import urlopen"),
    (no_silent_except, "core/foundation/store.py", "try:\n    f()\nexcept OSError:\n    pass"),
    (no_silent_except, "core/foundation/store.py", "try:\n    f()\nexcept:\n    g()"),
    (state_is_in_the_session, "addon/jobs.py", "_current: list[Job] = []"),
    (state_is_in_the_session, "addon/jobs.py", "LISTENERS = []"),
    (state_is_in_the_session, "addon/jobs.py", "known = {'L': 1}"),
    (state_is_in_the_session, "addon/jobs.py", "_opened = OrderedDict()"),
    (state_is_in_the_session, "addon/jobs.py", "NAMES = ['L']\ndef f():\n    NAMES.append('R')"),
    (state_is_in_the_session, "addon/steps/watch.py", "from .. import jobs\njobs.ENDED['x'] = 1"),
    (state_is_in_the_session, "addon/jobs.py", "COUNT = 0\ndef f():\n    global COUNT\n    COUNT = 1"),
    (state_is_in_the_session, "addon/clicking/operators.py", "class ClickOperator:\n    running: ClassVar[list[int]] = []"),
    (scipy_is_imported_where_it_is_used, "core/matching/seeds.py", "from scipy.ndimage import label"),
    (scipy_is_imported_where_it_is_used, "addon/jobs.py", "import scipy.linalg"),
    (files_stay_small, "core/take/take.py", "x = 1\n" * (LONGEST_FILE + 1)),
]
ACCEPTED: list[tuple[Rule, str, str]] = [
    (
        layer_order,
        "core/matching/seeds.py",
        "from ..geometry.rig import Rig\nfrom ..foundation.errors import InputError\nfrom . import grid",
    ),
    (layer_order, "core/cli/main.py", "from ..synthetic import arm\nfrom ..run import pipeline"),
    (layer_order, "addon/jobs.py", "from ..core.run import pipeline"),
    (core_is_pure, "core/images/sampling.py", "import json\nimport cv2\nimport numpy as np\nfrom scipy import ndimage"),
    (core_is_pure, "core/run/batch.py", "def f():\n    from distributed import Client"),
    (bpy_stays_in_the_addon, "__init__.py", "def register():\n    from . import addon"),
    (imports_are_relative, "addon/jobs.py", "import bpy\nfrom ..core.run import pipeline"),
    (core_does_not_print, "core/cli/main.py", "print('done')"),
    (files_carry_no_code, "core/foundation/store.py", "np.load(path, allow_pickle=False)"),
    (files_are_opened_in_one_place, "core/take/take.py", "text = bounded.text_of(path, bounded.TOML_BYTES)\njson.dumps(text)"),
    (links_may_lead_in_a_circle, "core/take/take.py", "where, here = bounded.real_path(folder), Path(__file__).resolve()"),
    (patterns_are_matched_in_one_place, "core/take/take.py", "paths = bounded.matching(folder, pattern) or folder.glob('*.ply')"),
    (no_network, "core/cli/main.py", "import json"),
    (no_silent_except, "core/foundation/store.py", "try:\n    f()\nexcept OSError as error:\n    raise InputError('x') from error"),
    (state_is_in_the_session, "addon/session.py", "known = []"),
    (state_is_in_the_session, "addon/jobs.py", "NAMES = ['L']\ndef f():\n    found = []\n    found.append(NAMES[0])"),
    (state_is_in_the_session, "addon/jobs.py", "class Run:\n    bl_options = {'UNDO'}\n    def f(self):\n        self.found = []"),
    (scipy_is_imported_where_it_is_used, "core/matching/seeds.py", "def f():\n    from scipy.ndimage import label"),
    (
        scipy_is_imported_where_it_is_used,
        "core/matching/seeds.py",
        "from ..images import scipy\nif TYPE_CHECKING:\n    from scipy import sparse",
    ),
    (files_stay_small, "core/take/take.py", "x = 1\n" * LONGEST_FILE),
]
RULES = tuple(dict.fromkeys(rule for rule, _, _ in REJECTED))


@cache
def our_modules() -> dict[str, str]:
    """Name and source of every module that is shipped."""
    paths = [ROOT / "__init__.py", ROOT / "__main__.py", *sorted((ROOT / "core").rglob("*.py")), *sorted((ROOT / "addon").rglob("*.py"))]
    return {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in paths}


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_the_house_keeps_the_rule(rule: Rule) -> None:
    faults = [fault for name, source in our_modules().items() for fault in rule(name, source)]
    assert not faults, f"{rule.__doc__}\n" + "\n".join(faults)


@pytest.mark.parametrize(("rule", "name", "source"), REJECTED)
def test_the_rule_rejects_what_it_is_for(rule: Rule, name: str, source: str) -> None:
    assert rule(name, source)


@pytest.mark.parametrize(("rule", "name", "source"), ACCEPTED)
def test_the_rule_lets_good_code_pass(rule: Rule, name: str, source: str) -> None:
    assert rule(name, source) == []


def test_every_rule_has_samples_of_both_kinds() -> None:
    functions = [value for value in globals().values() if callable(value)]
    defined = {function for function in functions if getattr(function, "__annotations__", {}).get("return") == list[str]}
    assert defined == set(RULES) == {rule for rule, _, _ in ACCEPTED}


def test_all_modules_are_read() -> None:
    names = our_modules()
    assert {"__init__.py", "core/foundation/errors.py", "core/geometry/camera.py"} <= set(names)


def import_cycles(modules: dict[str, str]) -> tuple[str, ...]:
    """Modules that import each other in a circle, also inside one folder, at their heads or in functions: one line for each circle.

    What is imported for type checkers alone (`if TYPE_CHECKING:`) does not count: nothing is loaded for it.
    """
    dotted = {tuple(Path(name).with_suffix("").parts): name for name in modules}
    dotted |= {key[:-1]: name for key, name in dotted.items() if key[-1] == "__init__"}
    uses: dict[str, set[str]] = {}
    for name, source in modules.items():
        found = {dotted.get(module) or dotted.get(module[:-1]) for _, relative, module in imported(name, at_run_time(source)) if relative}
        uses[name] = {other for other in found if other is not None and other != name}
    while True:  # whatever imports nothing that is left is in no circle
        free = [name for name, others in uses.items() if not others & uses.keys()]
        if not free:
            break
        for name in free:
            del uses[name]
    circles: list[str] = []
    while uses:
        path = [min(uses)]
        while path[-1] not in path[:-1]:
            path.append(min(uses[path[-1]] & uses.keys()))
        circle = path[path.index(path[-1]) :]
        circles.append(" → ".join(circle))
        del uses[circle[0]]
        while free := [name for name, others in uses.items() if not others & uses.keys()]:
            for name in free:
                del uses[name]
    return tuple(circles)


def at_run_time(source: str) -> str:
    """The source without what stands under `if TYPE_CHECKING:`."""
    if "TYPE_CHECKING" not in source:
        return source
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = [ast.Pass()]
    return ast.unparse(tree)


def test_no_modules_import_each_other_in_a_circle() -> None:
    assert import_cycles(our_modules()) == ()


@pytest.mark.parametrize(
    ("modules", "circles"),
    [
        ({"core/body/a.py": "from .b import f", "core/body/b.py": "def f():\n    from . import a"}, 1),
        ({"core/a/x.py": "from ..b.y import f", "core/b/y.py": "from ..c import z", "core/c/z.py": "from ..a.x import g"}, 1),
        ({"core/a/__init__.py": "from .x import f", "core/a/x.py": "from . import g"}, 1),
        ({"core/a/x.py": "from . import y\nfrom . import z", "core/a/y.py": "from . import z", "core/a/z.py": ""}, 0),
        ({"core/a/x.py": "if TYPE_CHECKING:\n    from . import y", "core/a/y.py": "from . import x"}, 0),
        (
            {
                "core/a/v.py": "from . import w",
                "core/a/w.py": "from . import v",
                "core/a/x.py": "from . import y",
                "core/a/y.py": "from . import x",
            },
            2,
        ),
    ],
)
def test_circles_are_found(modules: dict[str, str], circles: int) -> None:
    assert len(import_cycles(modules)) == circles
