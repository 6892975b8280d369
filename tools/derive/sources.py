"""What the source of a class says by itself: which words keys are compared with, which keys are read, which are popped."""
import ast
import functools
import inspect
import re
import sys
import textwrap

from .configs import CONFIG_BASE


def texts(*classes):
    """Source of the modules that the classes stand in."""
    for module in dict.fromkeys(c.__module__ for c in classes):
        try:
            yield inspect.getsource(sys.modules[module])
        except (OSError, TypeError, KeyError):
            pass


def bases(cls, stop):
    """A class and what it inherits from, short of the library's own base classes."""
    return [c for c in cls.__mro__ if c.__module__.startswith(("transformers.models", "transformers_modules")) and c is not stop]


def popped(config_class):
    """Keys that a config class takes out of its keyword arguments by name."""
    found = []
    for c in bases(config_class, CONFIG_BASE):
        try:
            text = inspect.getsource(c)
        except (OSError, TypeError):
            continue
        for key in re.findall(r"\bkwargs\.(?:pop|get|setdefault)\(\s*[\"'](\w+)[\"']", text) + re.findall(r"[\"'](\w+)[\"'] (?:not )?in kwargs", text) + re.findall(r"\bkwargs\[[\"'](\w+)[\"']\]", text):
            if key not in found:
                found.append(key)
    return found


def constructed(tree):
    """The functions of a module that may run while a model is built: constructors and what stands outside of `forward`."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and not re.match(r"forward|generate|prepare_inputs|_reorder|get_(image|video|audio)_features|loss|_init_weights|_update|compute", node.name):
            yield node


class Reads(ast.NodeVisitor):
    """`config.key`, `self.config.key`, `getattr(config, "key", …)`, `hasattr(config, "key")`, of any name with config in it."""

    def __init__(self):
        self.keys = set()

    def visit_Attribute(self, node):
        if is_config(node.value) and isinstance(node.ctx, ast.Load):
            self.keys.add(node.attr)
        self.generic_visit(node)

    def visit_Call(self, node):
        if isinstance(node.func, ast.Name) and node.func.id in ("getattr", "hasattr") and len(node.args) > 1 and is_config(node.args[0]):
            if isinstance(node.args[1], ast.Constant) and isinstance(node.args[1].value, str):
                self.keys.add(node.args[1].value)
        self.generic_visit(node)


def is_config(node):
    name = node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""
    return "config" in name.lower() or name == "cfg"


@functools.lru_cache(maxsize=None)
def module_reads(module):
    """Keys that the constructors of a module read."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError, KeyError, SyntaxError):
        return frozenset()
    reads = Reads()
    for function in constructed(tree):
        for statement in function.body:
            reads.visit(statement)
    return frozenset(reads.keys)


class SelfReads(ast.NodeVisitor):
    """`self.key` and `getattr(self, "key", …)` in a config class."""

    def __init__(self):
        self.keys = set()

    def visit_Attribute(self, node):
        if isinstance(node.value, ast.Name) and node.value.id == "self" and isinstance(node.ctx, ast.Load):
            self.keys.add(node.attr)
        self.generic_visit(node)

    def visit_Call(self, node):
        if isinstance(node.func, ast.Name) and node.func.id in ("getattr", "hasattr") and len(node.args) > 1:
            if isinstance(node.args[0], ast.Name) and node.args[0].id == "self" and isinstance(node.args[1], ast.Constant):
                self.keys.add(str(node.args[1].value))
        self.generic_visit(node)


def config_reads(config_class):
    """Keys that a config class reads of itself or of its keyword arguments: what is computed may depend on them."""
    keys = set(popped(config_class))
    for c in bases(config_class, CONFIG_BASE):
        try:
            tree = ast.parse(textwrap.dedent(inspect.getsource(c)))
        except (OSError, TypeError, SyntaxError):
            continue
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef) and function.name in ("__init__", "__post_init__"):
                reads = SelfReads()
                reads.visit(function)
                keys |= reads.keys
    return sorted(k for k in keys if not k.startswith("_") and not callable(getattr(config_class, k, None)))


def model_reads(cls):
    """Keys that the constructors of a class's module, and of those of what it inherits, read."""
    return sorted({k for c in bases(cls, None) for k in module_reads(c.__module__)})
