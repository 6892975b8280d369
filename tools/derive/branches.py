"""Configs on both sides of what the constructors of a class compare config values with, and which of these sides ran.

The source of a class, of its parts and of their config classes is read for comparisons of a key with a constant, for lengths of
lists and for keys that are tested as they are. Each gives values for the key, and each value a config that differs in it alone.
While a class is built, the sides of every `if` that mentions a key are noted.
"""

import ast
import functools
import inspect
import sys
import time

from . import configs, draw, sources

SECONDS = 90  # for one class
MOST = 120  # configs of one class
MODELS = "transformers/models/"


def key_of(node):
    """The config key that an expression may read: `config.key`, `self.key`, `key`, `getattr(config, "key", …)`."""
    if isinstance(node, ast.Attribute):
        return node.attr
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "getattr" and len(node.args) > 1:
        return node.args[1].value if isinstance(node.args[1], ast.Constant) else None
    return None


def constants(node):
    """The constants of an expression that is one, or a literal of several."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and isinstance(node.operand, ast.Constant):
        return [-node.operand.value]
    if isinstance(node, ast.Constant):
        return [node.value]
    if isinstance(node, (ast.Tuple, ast.List, ast.Set)):
        return [value for each in node.elts for value in constants(each)]
    return []


class Comparisons(ast.NodeVisitor):
    """{key: constants it is compared with}, keys whose length is compared, and keys that are tested as they are."""

    def __init__(self):
        self.constants, self.lengths, self.tested = {}, set(), set()

    def visit_Compare(self, node):
        sides = [node.left, *node.comparators]
        for side in sides:
            if isinstance(side, ast.Call) and isinstance(side.func, ast.Name) and side.func.id == "len" and side.args:
                self.lengths.add(key_of(side.args[0]))
            elif key := key_of(side):
                found = [value for other in sides if other is not side for value in constants(other)]
                self.constants.setdefault(key, []).extend(found)
        self.generic_visit(node)

    def visit_If(self, node):
        self.test(node.test)
        self.generic_visit(node)

    visit_IfExp = visit_While = visit_If

    def test(self, node):
        if isinstance(node, ast.BoolOp):
            for each in node.values:
                self.test(each)
        elif isinstance(node, ast.UnaryOp):
            self.test(node.operand)
        elif key := key_of(node):
            self.tested.add(key)


@functools.lru_cache(maxsize=None)
def comparisons(module):
    found = Comparisons()
    for function in functions(module):
        found.visit(function)
    return found


@functools.lru_cache(maxsize=None)
def functions(module):
    """The functions of a module that may run while a model is built."""
    try:
        return list(sources.constructed(ast.parse(inspect.getsource(sys.modules[module]))))
    except (OSError, TypeError, KeyError, SyntaxError):
        return []


def modules(model):
    """The modules of a model's parts, its config and what they inherit from."""
    classes = {type(each) for each in model.modules()} | {type(part) for part in parts(model.config)}
    return sorted({base.__module__ for cls in classes for base in sources.bases(cls, None)})


def parts(config):
    yield config
    for value in vars(config).values():
        if isinstance(value, configs.CONFIG_BASE):
            yield from parts(value)


def values(key, value, found, words):
    """Values for a key on other sides of what it is compared with."""
    out = []
    if isinstance(value, bool):
        out.append(not value)
    if key in found["tested"] and not isinstance(value, bool):
        out += [None] if value is not None else configs.alternatives(key, None, words)[:1]
        out += [0] if isinstance(value, int) else []
    for constant in found["constants"].get(key, []):
        if isinstance(constant, (int, float)) and not isinstance(constant, bool):
            out += [constant - 1, constant, constant + 1]
        elif constant is None and value is None:
            out += configs.alternatives(key, None, words)[:2]
        elif isinstance(constant, (str, bool, type(None))):
            out.append(constant)
    if isinstance(value, list) and value and (key in found["lengths"] or not isinstance(value[0], dict)):
        out += [value[:-1], [*value, value[-1]]]
    unlike = [each for each in out if (type(each), each) != (type(value), value)]
    return [each for at, each in enumerate(unlike) if (type(each), each) not in [(type(v), v) for v in unlike[:at]]]


def changed(config, words, found, path=()):
    """(path of a key, config with another value of it) for each value that a source compares the key with."""
    for key, value in sorted(config.items()):
        if isinstance(value, dict) and "model_type" in value:
            for place, inner in changed(value, words, found, (*path, key)):
                yield place, {**config, key: inner}
        elif not draw.NOISE.search(key) and not draw.TOKENS.search(key) and key not in ("model_type", "architectures"):
            for each in values(key, value, found, words):
                yield (*path, key), {**config, key: each}


class Sides:
    """The sides of each `if` of constructors that ran: (file, line of the test, whether it held)."""

    def __init__(self):
        self.ran, self.tests = set(), {}

    def add(self, module, keys):
        """The tests of a module that mention a key."""
        file = getattr(sys.modules.get(module), "__file__", None)
        for function in functions(module) if file else ():
            for node in ast.walk(function):
                if isinstance(node, ast.If) and keys & {key_of(each) for each in ast.walk(node.test)}:
                    self.tests[file, node.lineno] = (function, node)

    def __enter__(self):
        self.before = sys.gettrace()
        sys.settrace(self.called)
        return self

    def __exit__(self, *_):
        sys.settrace(self.before)

    def called(self, frame, event, _):
        if MODELS not in frame.f_code.co_filename:
            return None
        last = [frame.f_lineno]

        def line(frame, event, _):
            if event == "line":
                self.ran.add((frame.f_code.co_filename, last[0], frame.f_lineno))
                last[0] = frame.f_lineno
            elif event == "return":
                self.ran.add((frame.f_code.co_filename, last[0], -1))
            return line

        return line

    def counted(self):
        """(sides that ran, sides of tests that were reached, those that did not: "file:line: test, held or not")."""
        ran, total, never = 0, 0, []
        for (file, at), (_, node) in sorted(self.tests.items(), key=lambda each: each[0]):
            targets = {to for f, since, to in self.ran if f == file and at <= since <= (node.test.end_lineno or at)}
            targets -= set(range(at, (node.test.end_lineno or at) + 1))
            if not targets:
                continue  # a function of another class
            body = node.body[0].lineno
            for side, has_run in (("held", body in targets), ("failed", bool(targets - {body}))):
                total += 1
                if has_run:
                    ran += 1
                else:
                    never.append(f"{file.split(MODELS)[-1]}:{at}: {ast.unparse(node.test)[:90]}: {side} never")
        return ran, total, never


def drawn(cls, seed):
    """Records as `draw.asked_now` has them, of configs on all sides, and the sides that ran."""
    config_class = cls.config_class
    raws = draw.raws_for(cls, config_class, config_class.model_type, seed, 2)
    if not raws:
        return [], None
    drawer = draw.Drawer(cls, config_class, {"traced": {"absent": {}}}, seed)
    sides, rows, started = Sides(), [], time.time()
    for raw in raws:
        saved = drawer.saved(raw)
        model = draw.build(cls, config_class.from_dict(configs.copied(saved))).instance
        found = {"constants": {}, "lengths": set(), "tested": set()}
        for module in modules(model):
            told = comparisons(module)
            for key, each in told.constants.items():
                found["constants"].setdefault(key, []).extend(each)
            found["lengths"] |= told.lengths
            found["tested"] |= told.tested
            sides.add(module, keys_of(saved))
        asked = {key: None for key in sources.model_reads(cls) if key in {*found["constants"], *found["tested"]}}
        whole = {**{key: value for key, value in asked.items() if not hasattr(config_class(), key)}, **saved}
        tried = [((), saved), *changed(whole, drawer.words, found)]
        for place, config in tried[:MOST]:
            if time.time() - started > SECONDS:
                break
            config = {key: value for key, value in config.items() if value is not None or key in saved or place == (key,)}
            try:
                with sides:
                    row = drawer.record(config, "branches")
            except (draw.TooSlow, MemoryError):
                continue
            if row:
                rows.append({**row, "place": "/".join(place)})
    return rows, sides.counted()


def keys_of(config):
    keys = set(config)
    for value in config.values():
        if isinstance(value, dict):
            keys |= keys_of(value)
    return keys
