"""Numbers, words and lists that remember which config keys they come from.

A class that is built with them tells its own formulas: what each dimension is made of, how far its loops run, what it
compares. These are candidates, not facts: each has to explain every sample before it is used (`fit.py`).
"""

import builtins
import re
import sys

import torch
import transformers

BASE = getattr(transformers, "PretrainedConfig", None) or transformers.PreTrainedConfig
LONGEST = 240  # characters from which an expression is no longer followed
LONG_LOOP = 512  # rounds from which a loop's index is a plain number
SIMPLE = re.compile(r"[\w.@]+(\[[^\[\]]*\])*|[a-z]+\([^()]*\)")
VARIABLE = re.compile(r"c\.[\w.]+(\[[^\[\]]*\])?")


class Record:
    """What one instantiation told."""

    def __init__(self):
        self.literals, self.counts, self.reads, self.absent, self.opaque = {}, {}, {}, {}, False


class State:
    record = None  # where to; None while nothing is followed
    sites = {}
    injected = set()
    modules = 0


def site():
    """A number for the place in the source that asks."""
    frame = sys._getframe(2)
    return State.sites.setdefault((frame.f_code.co_filename, frame.f_lineno), len(State.sites))


def literal(text):
    if State.record is not None and len(text) < LONGEST:
        State.record.literals.setdefault(text, True)


def said(x):
    """The expression of a value; a plain number's own digits; None for one that is not followed."""
    e = getattr(x, "e", None)
    if e is not None:
        return e
    if isinstance(x, bool) or x is None:
        return None
    return repr(x) if isinstance(x, (int, float)) and x >= 0 and type(x) in (int, float) else None


def wrapped(text):
    return text if SIMPLE.fullmatch(text) else f"({text})"


def real(x):
    """As a floating-point number."""
    e = said(x)
    if e is None:
        return None
    return e if isinstance(x, float) and not VARIABLE.fullmatch(e) else f"double({e})"


def made(kind, value, text):
    if text is None or len(text) > LONGEST or State.record is None:
        return value
    return kind(value, text)


def binary(name, sign, neutral=None):
    plain = getattr(int, f"__{name}__")

    def left(a, b):
        value = plain(a, b) if isinstance(b, int) else NotImplemented
        if value is NotImplemented:
            return real_binary(a, b, sign) if isinstance(b, float) else value
        x, y = said(a), said(b)
        if x is None or y is None:
            return value
        if neutral is not None and y == str(neutral):
            return a
        return made(Int, value, f"{wrapped(x) if sign in '*/%' else x} {sign} {wrapped(y)}")

    def right(a, b):
        value = plain(b, a) if isinstance(b, int) else NotImplemented
        if value is NotImplemented:
            return real_binary(b, a, sign) if isinstance(b, float) else value
        x, y = said(b), said(a)
        if x is None or y is None:
            return value
        if neutral is not None and x == str(neutral) and sign in "+*":
            return a
        return made(Int, value, f"{wrapped(x) if sign in '*/%' else x} {sign} {wrapped(y)}")

    return left, right


REAL = {"+": lambda a, b: a + b, "-": lambda a, b: a - b, "*": lambda a, b: a * b, "/": lambda a, b: a / b}


def real_binary(a, b, sign):
    value = REAL.get(sign, lambda a, b: NotImplemented)(float(a), float(b))
    x, y = real(a), real(b)
    if value is NotImplemented or x is None or y is None:
        return value
    out = made(Float, value, f"{wrapped(x)} {sign} {wrapped(y)}")
    if sign == "/" and isinstance(out, Float) and isinstance(a, int) and isinstance(b, int):
        out.ratio = (a, b)
    return out


def compare(sign):
    plain = {"==": "__eq__", "!=": "__ne__", "<": "__lt__", "<=": "__le__", ">": "__gt__", ">=": "__ge__"}[sign]

    def asked(a, b):
        kind = int if isinstance(a, int) else float if isinstance(a, float) else str
        value = getattr(kind, plain)(a, b)
        x, y = said(a), said(b)
        if value is not NotImplemented and x is not None and y is not None and isinstance(b, (int, float)):
            literal(f"{x} {sign} {y}")
        return value

    return asked


class Int(int):
    """A whole number with the expression it comes from."""

    def __new__(cls, value, e):
        out = int.__new__(cls, value)
        out.e = e
        return out

    __add__, __radd__ = binary("add", "+", 0)
    __sub__, __rsub__ = binary("sub", "-", 0)
    __mul__, __rmul__ = binary("mul", "*", 1)
    __floordiv__, __rfloordiv__ = binary("floordiv", "/", 1)
    __mod__, __rmod__ = binary("mod", "%")
    __eq__, __ne__, __lt__, __le__, __gt__, __ge__ = map(compare, ("==", "!=", "<", "<=", ">", ">="))
    __hash__ = int.__hash__

    def __truediv__(self, other):
        return real_binary(self, other, "/") if isinstance(other, (int, float)) else NotImplemented

    def __rtruediv__(self, other):
        return real_binary(other, self, "/") if isinstance(other, (int, float)) else NotImplemented

    def __pow__(self, other, mod=None):
        value = int.__pow__(int(self), other) if mod is None else pow(int(self), other, mod)
        if type(other) is int and other == 2 and isinstance(value, int):
            return made(Int, value, f"{wrapped(self.e)} * {wrapped(self.e)}")
        return value

    def __rpow__(self, other):
        value = other ** int(self)
        return made(Int, value, f"pow({other}, {self.e})") if type(other) is int and isinstance(value, int) else value

    def __neg__(self):
        return made(Int, -int(self), f"0 - {wrapped(self.e)}")

    def __bool__(self):
        literal(f"{self.e} != 0")
        return int(self) != 0

    def __int__(self):
        return int.__add__(self, 0)

    def __deepcopy__(self, memo):
        return self

    def __copy__(self):
        return self

    def __reduce_ex__(self, protocol):
        return int, (int(self),)


class Float(float):
    """A number with the expression it comes from."""

    ratio = None

    def __new__(cls, value, e):
        out = float.__new__(cls, value)
        out.e = e
        return out

    __eq__, __ne__, __lt__, __le__, __gt__, __ge__ = map(compare, ("==", "!=", "<", "<=", ">", ">="))
    __hash__ = float.__hash__

    def __add__(self, other):
        return real_binary(self, other, "+") if isinstance(other, (int, float)) else NotImplemented

    def __radd__(self, other):
        return real_binary(other, self, "+") if isinstance(other, (int, float)) else NotImplemented

    def __sub__(self, other):
        return real_binary(self, other, "-") if isinstance(other, (int, float)) else NotImplemented

    def __rsub__(self, other):
        return real_binary(other, self, "-") if isinstance(other, (int, float)) else NotImplemented

    def __mul__(self, other):
        return real_binary(self, other, "*") if isinstance(other, (int, float)) else NotImplemented

    def __rmul__(self, other):
        return real_binary(other, self, "*") if isinstance(other, (int, float)) else NotImplemented

    def __truediv__(self, other):
        return real_binary(self, other, "/") if isinstance(other, (int, float)) else NotImplemented

    def __rtruediv__(self, other):
        return real_binary(other, self, "/") if isinstance(other, (int, float)) else NotImplemented

    def whole(self):
        value = int(float(self))
        if self.ratio and value >= 0:
            a, b = map(said, self.ratio)
            return made(Int, value, f"{wrapped(a)} / {wrapped(b)}")
        return made(Int, value, f"floor({real(self)})") if value >= 0 else value

    def __floor__(self):
        return self.whole() if self >= 0 else int(float(self) // 1)

    def __trunc__(self):
        return self.whole()

    def __ceil__(self):
        value = -int(-float(self) // 1)
        if self.ratio:
            a, b = map(said, self.ratio)
            return made(Int, value, f"({a} + {wrapped(b)} - 1) / {wrapped(b)}")
        return made(Int, value, f"ceil({real(self)})")

    def __deepcopy__(self, memo):
        return self

    def __copy__(self):
        return self

    def __reduce_ex__(self, protocol):
        return float, (float(self),)


def quoted(s):
    return '"' + s.replace("\\", "\\\\").replace('"', '\\"') + '"'


class Str(str):
    """A word with the key it stands under."""

    def __new__(cls, value, e):
        out = str.__new__(cls, value)
        out.e = e
        return out

    def __eq__(self, other):
        if type(other) is str:
            literal(f"{self.e} == {quoted(other)}")
        return str.__eq__(self, other)

    def __ne__(self, other):
        if type(other) is str:
            literal(f"{self.e} == {quoted(other)}")
        return str.__ne__(self, other)

    __hash__ = str.__hash__

    def startswith(self, prefix, *more):
        if type(prefix) is str and not more:
            literal(f"{self.e}.startsWith({quoted(prefix)})")
        return str.startswith(self, prefix, *more)

    def endswith(self, suffix, *more):
        if type(suffix) is str and not more:
            literal(f"{self.e}.endsWith({quoted(suffix)})")
        return str.endswith(self, suffix, *more)

    def __contains__(self, part):
        if type(part) is str:
            literal(f"{self.e}.contains({quoted(part)})")
        return str.__contains__(self, part)

    def split(self, sep=None, maxsplit=-1):
        out = str.split(self, sep, maxsplit)
        return [Piece(out[0], self.e, sep), *out[1:]] if sep else out

    def __deepcopy__(self, memo):
        return self

    def __copy__(self):
        return self

    def __reduce_ex__(self, protocol):
        return str, (str(self),)


class Piece(str):
    """What stands before the first separator in a word."""

    def __new__(cls, value, e, sep):
        out = str.__new__(cls, value)
        out.whole, out.sep = e, sep
        return out

    def __eq__(self, other):
        if type(other) is str:
            literal(f"{self.whole}.startsWith({quoted(other + self.sep)})")
        return str.__eq__(self, other)

    __hash__ = str.__hash__

    def __reduce_ex__(self, protocol):
        return str, (str(self),)


class List(list):
    """A list with the key it stands under; what is taken from it knows where it stood."""

    def __init__(self, values, e):
        list.__init__(self, values)
        self.e = e

    def at(self, n):
        return follow(list.__getitem__(self, n), f"{self.e}[{n}]" if n >= 0 else f"{self.e}[size({self.e}) - {-n}]")

    def __getitem__(self, n):
        if isinstance(n, slice):
            return [self.at(k) for k in range(*n.indices(list.__len__(self)))]
        if isinstance(n, Int):
            return follow(list.__getitem__(self, int(n)), f"{self.e}[{n.e}]") if n >= 0 else list.__getitem__(self, int(n))
        return self.at(n) if isinstance(n, int) else list.__getitem__(self, n)

    def __iter__(self):
        return (self.at(n) for n in range(list.__len__(self)))

    def __reversed__(self):
        return (self.at(n) for n in reversed(range(list.__len__(self))))

    def __contains__(self, x):
        e = said(x) if isinstance(x, (int, float)) else quoted(x) if type(x) is str else None
        if e is not None:
            literal(f"{e} in {self.e}")
        return any(x == y for y in list.__iter__(self))

    def __add__(self, other):
        return [*self, *other]

    def __radd__(self, other):
        return [*other, *self]

    def __deepcopy__(self, memo):
        return List(list(list.__iter__(self)), self.e)

    def __copy__(self):
        return self

    def __reduce_ex__(self, protocol):
        return list, (list(list.__iter__(self)),)


def follow(value, e):
    """The value, followed from here on, where it is of a kind that can be."""
    if State.record is None or len(e) > LONGEST:
        return value
    if isinstance(value, bool) or value is None or getattr(value, "e", None) is not None:
        return value
    if type(value) is int:
        return Int(value, e)
    if type(value) is float:
        return Float(value, e)
    if type(value) is str:
        return Str(value, e)
    if type(value) in (list, tuple):
        return List(value, e)
    return value


# ---- what takes the place of builtins in modeling and configuration modules ---------------------------------------


class Whole(type):
    def __instancecheck__(cls, x):
        return isinstance(x, int)

    def __subclasscheck__(cls, x):
        return issubclass(x, int)


class int_(int, metaclass=Whole):
    def __new__(cls, x=0, *more):
        if isinstance(x, Int):
            return x
        return x.whole() if isinstance(x, Float) else int(x, *more)


def range_(*args):
    plain = range(*(int(a) for a in args))
    if State.record is None or len(plain) > LONG_LOOP:
        return plain
    e = [said(a) for a in args]
    if any(isinstance(a, Int) for a in args) and None not in e:
        State.record.counts[e[0] if len(e) == 1 else f"{e[1]} - {wrapped(e[0])}"] = True
    at = site()
    return Rounds([Int(n, f"@{n}_{at}") if n >= 0 else n for n in plain])


class Rounds(list):
    """What a loop goes through."""


def enumerate_(iterable, start=0):
    if State.record is None:
        return enumerate(iterable, start)
    return rounds(iterable, start, site())


def rounds(iterable, start, at):
    if isinstance(iterable, List):
        State.record and State.record.counts.setdefault(f"size({iterable.e})", True)
        for n in range(list.__len__(iterable)):
            yield (
                Int(n + start, f"@{n + start}_{at}"),
                follow(list.__getitem__(iterable, n), f"{iterable.e}[@{n}_{at}]" if not start else f"{iterable.e}[{n}]"),
            )
    else:
        for n, x in enumerate(iterable, start):
            yield (Int(n, f"@{n}_{at}") if n < LONG_LOOP else n), x


def len_(x):
    if isinstance(x, List) and State.record is not None:
        return Int(len(x), f"size({x.e})")
    return len(x)


def extreme(name):
    plain = getattr(builtins, name)

    def f(*args, **kwargs):
        if len(args) == 2 and not kwargs and any(isinstance(a, Int) for a in args) and all(isinstance(a, int) for a in args):
            x, y = map(said, args)
            value = plain(int(args[0]), int(args[1]))
            return made(Int, value, f"{name}({x}, {y})") if x is not None and y is not None else value
        return plain(*args, **kwargs)

    return f


def sum_(x, *start):
    if isinstance(x, List) and not start and all(type(v) is int for v in list.__iter__(x)):
        return made(Int, sum(list.__iter__(x)), f"sum({x.e})")
    return sum(x, *start)


def getattr_(x, name, *default):
    if not default or not isinstance(x, BASE) or State.record is None:
        return getattr(x, name, *default)
    try:
        return getattr(x, name)
    except AttributeError:
        note_absent(x, name, default[0])
        return default[0]


def hasattr_(x, name):
    found = hasattr(x, name)
    if not found and isinstance(x, BASE):
        note_absent(x, name, None)
    return found


def note_absent(config, name, default):
    path = vars(config).get("_trace")
    if State.record is not None and path is not None and not name.startswith("_"):
        e = said(default) if isinstance(default, (int, float)) and not isinstance(default, bool) else None
        plain = default if isinstance(default, (bool, int, float, str, type(None))) else None
        State.record.absent.setdefault(path + name, [plain if e is None or type(default) in (int, float) else None, e])


STANDINS = {
    "int": int_,
    "range": range_,
    "enumerate": enumerate_,
    "len": len_,
    "max": extreme("max"),
    "min": extreme("min"),
    "sum": sum_,
    "getattr": getattr_,
    "hasattr": hasattr_,
}
FOLLOWED = re.compile(
    r"transformers\.(models\.|modeling_layers|pytorch_utils|backbone_utils|utils\.backbone_utils|modeling_rope)|transformers_modules"
)


def inject():
    """Puts the stand-ins into every module of models that was imported since."""
    if len(sys.modules) == State.modules:
        return
    State.modules = len(sys.modules)
    for name, module in list(sys.modules.items()):
        if name not in State.injected and FOLLOWED.match(name):
            State.injected.add(name)
            if type(module).__name__ == "_LazyModule":
                continue
            for builtin, standin in STANDINS.items():
                vars(module).setdefault(builtin, standin)


def patch_torch():
    """Makes new tensors keep the expressions of their dimensions."""
    for name in ("empty", "zeros", "ones", "rand", "randn", "full"):
        setattr(torch, name, keeping(getattr(torch, name)))
    for kind in (torch.nn.Parameter, torch.nn.Buffer):
        kind.__new__ = passing_on(kind.__new__)


def passing_on(plain):
    def new(cls, data=None, *args, **kwargs):
        out = plain(cls, data, *args, **kwargs)
        if getattr(data, "_dims", None) is not None:
            out._dims = data._dims
        return out

    return new


def keeping(plain):
    def f(*args, **kwargs):
        out = plain(*args, **kwargs)
        if State.record is not None and args:
            dims = args[0] if isinstance(args[0], (tuple, list)) else [a for a in args if isinstance(a, int)]
            if any(isinstance(d, Int) for d in dims):
                out._dims = [said(d) for d in dims]
        return out

    return f


def patch_configs():
    """Makes configs tell which keys are read."""
    plain = BASE.__getattribute__

    def read(self, key):
        record = State.record
        if record is None or key.startswith("_") or key == "attribute_map":
            return plain(self, key)
        value = plain(self, key)
        own = plain(self, "__dict__")
        path = own.get("_trace")
        if path is not None:
            key = (plain(self, "attribute_map") or {}).get(key, key)
            if key in own or key == "num_labels" or "_" + key in own:
                record.reads[path + key] = record.reads.get(path + key, 0) + 1
        return value

    BASE.__getattribute__ = read
    for name in ("to_dict", "to_diff_dict"):
        setattr(BASE, name, whole(getattr(BASE, name)))


def whole(plain):
    """A method that reads every key."""

    def f(self, *args, **kwargs):
        if State.record is not None and "_trace" in vars(self):
            State.record.opaque = True
        return plain(self, *args, **kwargs)

    return f


def install():
    patch_torch()
    patch_configs()


def mark(config, prefix="", seen=None):
    """Puts values that are followed into a config and those inside it."""
    seen = set() if seen is None else seen
    if id(config) in seen:
        return
    seen.add(id(config))
    own = vars(config)
    own["_trace"] = prefix
    for key, value in list(own.items()):
        if key.startswith("_") or key in ("id2label", "label2id"):
            continue
        if isinstance(value, BASE):
            mark(value, f"{prefix}{key}.", seen)
        else:
            own[key] = follow(value, f"c.{prefix}{key}")


class following:
    """While it lasts, what is built is followed; `record` has what it told."""

    def __enter__(self):
        State.record = Record()
        inject()
        return State.record

    def __exit__(self, *_):
        State.record = None


def dimensions(model):
    """{tensor name: [expression or None for each dimension]} of what was built while followed."""
    out = {}
    for module_name, module in model.named_modules():
        prefix = f"{module_name}." if module_name else ""
        for own in (module._parameters, module._buffers):
            for name, tensor in own.items():
                dims = getattr(tensor, "_dims", None)
                if dims is not None and len(dims) == tensor.dim():
                    out[prefix + name] = dims
    return out
