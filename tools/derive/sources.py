"""What the source of a class says by itself: which words keys are compared with, which keys are read, which are popped."""

import ast
import functools
import inspect
import re
import sys
import textwrap
import types
import typing

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
    return [
        c for c in cls.__mro__ if c.__module__.startswith(("transformers.models", "transformers_modules")) and c is not stop
    ]


def popped(config_class):
    """Keys that a config class takes out of its keyword arguments by name."""
    found = []
    for c in bases(config_class, CONFIG_BASE):
        try:
            text = inspect.getsource(c)
        except (OSError, TypeError):
            continue
        for key in (
            re.findall(r"\bkwargs\.(?:pop|get|setdefault)\(\s*[\"'](\w+)[\"']", text)
            + re.findall(r"[\"'](\w+)[\"'] (?:not )?in kwargs", text)
            + re.findall(r"\bkwargs\[[\"'](\w+)[\"']\]", text)
        ):
            if key not in found:
                found.append(key)
    return found


def constructed(tree):
    """The functions of a module that may run while a model is built: constructors and what stands outside of `forward`."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and not re.match(
            r"forward|generate|prepare_inputs|_reorder|get_(image|video|audio)_features|loss|_init_weights|_update|compute",
            node.name,
        ):
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
        if (
            isinstance(node.func, ast.Name)
            and node.func.id in ("getattr", "hasattr")
            and len(node.args) > 1
            and is_config(node.args[0])
        ):
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


PLAIN = {int: "int", float: "float", bool: "bool", str: "str", type(None): "null", list: "list", dict: "object"}


def field_types(config_class):
    """{key: what transformers 5 lets it be, in JSON's words}: `int|null`, `list[int]|null`, `"a"|"b"`; keys of one class."""
    if not hasattr(config_class, "__dataclass_fields__"):
        return {}
    out = {}
    for key, field in config_class.__dataclass_fields__.items():
        if key in CONFIG_BASE.__annotations__ or key.startswith("_"):
            continue
        text = told_type(field.type)
        if text:
            out[key] = text
    return out


def told_type(hint):
    """A type in JSON's words; None for one that cannot be told, or that takes everything."""
    if hint in PLAIN:
        return PLAIN[hint]
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        parts = [told_type(a) for a in args]
        return None if None in parts else "|".join(dict.fromkeys(p for part in parts for p in part.split("|") if p)) or None
    if origin is list:
        inner = told_type(args[0])
        return "list" if inner is None else f"list[{inner}]" if "[" not in inner else "list"
    if origin is tuple:
        return ""  # JSON has none
    if origin is dict:
        return "object"
    if origin is typing.Literal and all(isinstance(a, str) for a in args):
        return "|".join(f"'{a}'" for a in args)
    if isinstance(hint, type) and (issubclass(hint, (CONFIG_BASE, dict)) or typing.is_typeddict(hint)):
        return "object"
    return None


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
