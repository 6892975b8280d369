"""Building models without their weights, and reading off what they consist of."""

import contextlib
import signal

import torch
import transformers
from transformers import PreTrainedModel, modeling_utils

from .configs import flatten, subconfigs

ALARM = 12  # seconds one instantiation may take


class TooSlow(Exception):
    """An instantiation took longer than its limit."""


@contextlib.contextmanager
def time_limit(seconds):
    def ring(*_):
        raise TooSlow(f"took more than {seconds} s")

    signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)


def without_initialisation():
    """Make torch skip what only decides values: they do not matter here, and cost most of the time."""
    for name in list(vars(torch.nn.init)):
        if name.endswith("_") and not name.startswith("_") and callable(getattr(torch.nn.init, name)):
            setattr(torch.nn.init, name, lambda *a, **k: a[0] if a else k.get("tensor"))
    linspace, item, tolist = torch.linspace, torch.Tensor.item, torch.Tensor.tolist
    # Rates of stochastic depth are computed with these, and need values even on `meta`.
    torch.linspace = lambda *a, **k: linspace(*a, **{**k, "device": "cpu"})
    torch.Tensor.item = lambda t: 0.0 if t.device.type == "meta" else item(t)
    torch.Tensor.tolist = lambda t: [0.0] * t.numel() if t.device.type == "meta" else tolist(t)
    nn = torch.nn
    for kind in (nn.Linear, nn.Embedding, nn.LayerNorm, nn.modules.conv._ConvNd, nn.GroupNorm):
        kind.reset_parameters = lambda self: None
    # Not transformers' own switch for this: it would leave out tying weights as well.
    PreTrainedModel._initialize_weights = lambda *a, **k: None
    if transformers.__version__.startswith("4"):
        PreTrainedModel.init_weights = lambda self: self.tie_weights()
    PreTrainedModel.can_generate = classmethod(lambda cls: False)  # no generation config is made
    torch.set_num_threads(1)


class Built:
    """What one instantiation consists of."""

    __slots__ = ("flat", "tensors", "tied", "buffers", "persistent", "models", "modules", "facts", "instance", "config")


def build(cls, config, device="meta"):
    with time_limit(ALARM), torch.device(device):
        model = cls(config)
    return read(model, config)


def read(model, config):
    """Walk the modules once, in state-dict order: parameters, buffers, and models inside the model."""
    b = Built()
    b.tensors, b.tied, b.buffers, b.persistent, b.models = {}, [], [], [], []
    shares, count = {}, 0
    stack = [("", model)]
    while stack:
        prefix, module = stack.pop()
        count += 1
        if prefix and isinstance(module, PreTrainedModel):
            b.models.append((prefix, module))
        for n, p in module._parameters.items():
            if p is not None:
                b.tensors[prefix + n] = tuple(p.shape)
                shares.setdefault(id(p), []).append(prefix + n)
        for n, t in module._buffers.items():
            if t is None:
                continue
            if n in module._non_persistent_buffers_set:
                b.buffers.append(prefix + n)
            else:
                b.tensors[prefix + n] = tuple(t.shape)
                b.persistent.append(prefix + n)
                shares.setdefault(id(t), []).append(prefix + n)
        stack.extend((f"{prefix}{n}.", m) for n, m in reversed(module._modules.items()) if m is not None)
    b.tied = [names for names in shares.values() if len(names) > 1]
    b.modules = count
    b.instance = model
    return b


def nested_models(b, config):
    """[[prefix, class, model_type, where its config is]] of the models inside: "" the root's, "vision_config" a
    sub-config, None a config of its own (a changed copy, say)."""
    where = {id(config): ""}

    def walk(c, path):
        for k, v in subconfigs(c).items():
            where.setdefault(id(v), path + k)
            walk(v, path + k + ".")

    walk(config, "")
    by_value = {}
    for ident, path in where.items():
        if path:
            sub = config
            for p in path.split("."):
                sub = getattr(sub, p)
            by_value.setdefault((type(sub), essence(sub)), path)
    root = (type(config), essence(config))
    out = []
    for prefix, m in b.models:
        path = where.get(id(m.config))
        if path is None:
            key = (type(m.config), essence(m.config))
            path = by_value.get(key)
            if path is None and key == root:
                path = ""
        out.append([prefix, type(m).__name__, getattr(m.config, "model_type", ""), path])
    return out


def essence(config):
    """A config's values that may matter, to recognise a copy of it."""
    return repr(
        sorted(
            (k, v)
            for k, v in flatten(config).items()
            if isinstance(v, (bool, int, list, str))
            and "dtype" not in k
            and not k.startswith("_")
            and "attn_implementation" not in k
            and k not in ("transformers_version", "use_cache")
        )
    )


def alone(m, device):
    """The tensors of a model inside a model, and those that share their storage, when it is built by itself from the same
    config; or None."""
    try:
        with time_limit(ALARM), torch.device(device):
            other = type(m)(m.config)
    except TooSlow:
        raise
    except Exception:  # it wants more than a config
        return None
    b = read(other, m.config)
    return b.tensors, [frozenset(g) for g in b.tied]


def patterns(x):
    return sorted(str(getattr(p, "pattern", p)) for p in x) if x else []


def facts(b, cls):
    """What does not depend on the config: the class's own patterns and prefix."""
    m = b.instance
    prefix = m.base_model_prefix or ""
    return {
        "base_model_prefix": prefix,
        "has_base": bool(prefix) and hasattr(m, prefix),
        # The class's, not the instance's: transformers 5 adds those of the models inside to the instance.
        "ignore_missing": patterns(getattr(cls, "_keys_to_ignore_on_load_missing", None)),
        "ignore_unexpected": patterns(getattr(cls, "_keys_to_ignore_on_load_unexpected", None)),
        "tied_weights_keys": plain_ties(getattr(cls, "_tied_weights_keys", None)),
        "key_mapping": key_mapping(cls),
        "module": cls.__module__,
        "transformers": transformers.__version__,
    }


def key_mapping(cls):
    """What transformers 4.57 renames at load for this class: only where its name, or that of a base, is one of these."""
    wanted = getattr(modeling_utils, "VLMS", ())
    if any(word in base.__name__.lower() for base in cls.__mro__[:-1] for word in wanted):
        return [list(row) for row in (getattr(cls, "_checkpoint_conversion_mapping", None) or {}).items()]
    return []


def plain_ties(x):
    return dict(x) if isinstance(x, dict) else sorted(x) if x else []
