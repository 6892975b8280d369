#!/usr/bin/env python3
"""A toy trial: does a projector that is fitted between two vocabularies train faster than one that is scaled?

    fit_trial.py TEXTS [--seed N] [--pairs N] [--steps N] [--out FILE]

TEXTS is a directory with prose (*.md, *.rst, *.txt), for example that of Python packages. Two language models of other widths,
tokenizers and data learn to restate a scene. A projector learns to show the first one a picture of the scene, alone (`frozen`)
or with its language model (`joint`). Then that projector is put before the second language model, which stays as it is, and
trained again from each of these starts:

    reinit    the class's own start
    pad       zeros up to the width, scaled as `projector=pad scale=text` does (image-rms 0.25)
    fit       W' = M W, b' = M (b - mean) + mean', where M is the ridge map from rows of whole words in the first
              embedding to those of the same words in the second one; scaled in the same way
    rotated   as fit, behind a random rotation: the same sizes, without the meaning

Printed are the training steps until the loss, a running mean over fresh batches, is below each goal.
"""

import argparse
import json
import math
import random
import re
import statistics
import time
from pathlib import Path

import numpy as np
import torch
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
from torch import nn
from torch.nn import functional as F

COLOURS = dict(red="lava", green="grass", blue="sea", yellow="lemon", black="coal", white="snow", pink="rose", brown="bark")
SHAPES = dict(
    circle="wheel", square="tile", triangle="sail", star="badge", cross="grave", ring="hoop", heart="card", arrow="sign"
)
CORNERS = ["top left", "top right", "bottom left", "bottom right"]
NUMBERS = ["one", "two", "three"]
GOALS = (0.6, 0.4, 0.3, 0.2)
LENGTH, BATCH, IMAGE, FEATURES = 64, 32, 4, 64


def scene(rng):
    corners = rng.sample(range(4), rng.choice((1, 2)))
    return [(rng.randrange(3), rng.choice(list(COLOURS)), rng.choice(list(SHAPES)), corner) for corner in corners]


def told(scene):
    return " and ".join(f"{NUMBERS[n]} {c} {s} in the {CORNERS[k]}" for n, c, s, k in scene)


def listed(scene):
    return "; ".join(f"the {CORNERS[k]} has the {c} {s}, {NUMBERS[n]}" for n, c, s, k in scene)


def asked(scene, rng):
    n, c, s, k = rng.choice(scene)
    return rng.choice(
        (
            f"what is in the {CORNERS[k]}? {NUMBERS[n]} {c} {s}",
            f"which colour has the {s}? it is {c}",
            f"where is the {c} {s}? in the {CORNERS[k]}",
        )
    )


def meaning(rng):
    colour, thing = rng.choice(list(COLOURS.items()))
    shape, other = rng.choice(list(SHAPES.items()))
    return rng.choice(
        (
            f"the {thing} turned {colour}",
            f"{colour} as {thing}",
            f"a {other} is a {shape}",
            f"this {other} has the form of a {shape}",
            f"the {colour} {thing} lies near a {other}, which is a {shape}",
        )
    )


def document(rng, prose):
    kind = rng.random()
    if kind < 0.5:
        s = scene(rng)
        return "\n".join((rng.choice((told(s), listed(s))), told(s), asked(s, rng)))
    if kind < 0.75:
        return "\n".join(meaning(rng) for _ in range(5))
    return rng.choice(prose)


def tokenizer(texts, size):
    core = Tokenizer(models.BPE())
    core.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=True)
    core.decoder = decoders.ByteLevel()
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    core.train_from_iterator(texts, trainers.BpeTrainer(vocab_size=size, initial_alphabet=alphabet, show_progress=False))
    return core


class Block(nn.Module):
    def __init__(self, d):
        super().__init__()
        self.heads, self.n1, self.n2 = d // 32, nn.RMSNorm(d), nn.RMSNorm(d)
        self.qkv, self.o = nn.Linear(d, 3 * d, bias=False), nn.Linear(d, d, bias=False)
        self.up, self.down = nn.Linear(d, 4 * d, bias=False), nn.Linear(4 * d, d, bias=False)

    def forward(self, x, turn):
        b, t, d = x.shape
        q, k, v = self.qkv(self.n1(x)).view(b, t, 3, self.heads, 32).permute(2, 0, 3, 1, 4)
        q, k = (
            torch.cat((a[..., :16] * turn[0] - a[..., 16:] * turn[1], a[..., 16:] * turn[0] + a[..., :16] * turn[1]), -1)
            for a in (q, k)
        )
        x = x + self.o(F.scaled_dot_product_attention(q, k, v, is_causal=True).transpose(1, 2).reshape(b, t, d))
        return x + self.down(F.gelu(self.up(self.n2(x))))


class Model(nn.Module):
    def __init__(self, rows, d, layers):
        super().__init__()
        self.embed = nn.Embedding(rows, d)
        nn.init.normal_(self.embed.weight, std=0.05)
        self.blocks, self.norm = nn.ModuleList(Block(d) for _ in range(layers)), nn.RMSNorm(d)

    def forward(self, x):
        angle = torch.arange(x.shape[1])[:, None] * 10000.0 ** (-torch.arange(16) / 16)
        for block in self.blocks:
            x = block(x, (angle.cos(), angle.sin()))
        return self.norm(x) @ self.embed.weight.T


def speak(core, d, prose, seed, steps):
    """A language model that learns to restate scenes, among other prose."""
    torch.manual_seed(seed)
    rng, model = random.Random(seed), Model(core.get_vocab_size(), d, 3)
    step = torch.optim.AdamW(model.parameters(), lr=2e-3, weight_decay=0.01)
    rate = torch.optim.lr_scheduler.OneCycleLR(step, 3e-3, steps)
    stream, last = [], []
    for i in range(steps):
        while len(stream) < BATCH * (LENGTH + 1):
            stream += core.encode(document(rng, prose) + "\n\n").ids
        ids = torch.tensor(stream[: BATCH * (LENGTH + 1)]).view(BATCH, -1)
        stream = stream[BATCH * (LENGTH + 1) :]
        loss = F.cross_entropy(model(model.embed(ids[:, :-1])).flatten(0, 1), ids[:, 1:].flatten())
        step.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        step.step()
        rate.step()
        last.append(loss.item())
    return model, statistics.mean(last[-50:])


class Tower:
    """Pictures as features: one for each corner, a random function of what is there, with noise."""

    def __init__(self, seed):
        draw = torch.Generator().manual_seed(seed)
        self.one, self.two = (torch.randn(n, m, generator=draw) / math.sqrt(n) for n, m in ((23, 128), (128, FEATURES)))

    def see(self, scenes, draw):
        x = torch.zeros(len(scenes), IMAGE, 23)
        for row, s in enumerate(scenes):
            for corner in range(4):
                x[row, corner, 19 + corner] = 1
            for n, c, shape, corner in s:
                x[row, corner, n] = x[row, corner, 3 + list(COLOURS).index(c)] = x[
                    row, corner, 11 + list(SHAPES).index(shape)
                ] = 1
        x = torch.tanh(2 * x @ self.one) @ self.two
        return x + 0.05 * torch.randn(x.shape, generator=draw)


def batch(core, rng, tower, draw):
    scenes = [scene(rng) for _ in range(BATCH)]
    ids = [core.encode(told(s) + "\n").ids for s in scenes]
    most = max(map(len, ids))
    return tower.see(scenes, draw), torch.tensor([i + [-100] * (most - len(i)) for i in ids])


def show(model, projector, seen, ids):
    """The loss of a caption behind a picture."""
    text = model.embed(ids.clamp(min=0))
    logits = model(torch.cat((projector(seen) if projector else text[:, :0], text), 1)[:, :-1])
    return F.cross_entropy(
        logits[:, -ids.shape[1] + (0 if projector else 1) :].flatten(0, 1),
        ids[:, 0 if projector else 1 :].flatten(),
        ignore_index=-100,
    )


def train(model, projector, core, tower, seed, steps, also=(), rate=2e-3, stop=None):
    """Trains a projector; returns the running mean of the loss at each step."""
    rng, draw, losses, mean = random.Random(seed), torch.Generator().manual_seed(seed), [], None
    step = torch.optim.AdamW(
        [{"params": projector.parameters()}, {"params": list(also), "lr": 5e-4}], lr=rate, weight_decay=0.0
    )
    for _ in range(steps):
        loss = show(model, projector, *batch(core, rng, tower, draw))
        step.zero_grad()
        loss.backward()
        step.step()
        losses.append(loss.item())
        mean = statistics.mean(losses[-5:])
        if stop is not None and len(losses) > 5 and mean < stop:
            break
    return losses


def words(core):
    """Rows of whole words."""
    return {t: i for t, i in core.get_vocab().items() if re.fullmatch("Ġ[a-zA-Z]{2,}", t)}


def ridge(x, y, size):
    return np.linalg.solve(x.T @ x + size * np.trace(x.T @ x) / x.shape[1] * np.eye(x.shape[1]), x.T @ y).T


def rms(x):
    return float(np.sqrt((x**2).mean()))


def starts(projector, one, two, cores, seed):
    """The projectors before the second model, and what is known of the map."""
    rng = np.random.default_rng(seed)
    shared = sorted(words(cores[0]).keys() & words(cores[1]).keys())
    rows = [m.embed.weight.detach().double().numpy() for m in (one, two)]
    x, y = (r[[words(c)[w] for w in shared]] for r, c in zip(rows, cores, strict=True))
    order, best = rng.permutation(len(shared)), None
    for size in (0.01, 0.03, 0.1, 0.3, 1.0, 3.0):
        found = []
        for fold in range(5):
            out = order[fold::5]
            kept = np.setdiff1d(order, out)
            a, b = x[kept].mean(0), y[kept].mean(0)
            guess, truth = (x[out] - a) @ ridge(x[kept] - a, y[kept] - b, size).T, y[out] - b
            found.append(((guess * truth).sum(1) / np.linalg.norm(guess, axis=1) / np.linalg.norm(truth, axis=1)).mean())
        best = max(best or (-1, 0), (float(np.mean(found)), size))
    m = ridge(x - x.mean(0), y - y.mean(0), best[1])
    w, b = (p.detach().double().numpy() for p in (projector.weight, projector.bias))
    d = rows[1].shape[1]
    grown = np.zeros((d, w.shape[1])), np.zeros(d)
    grown[0][: len(w)], grown[1][: len(b)] = w, b
    by = 0.25 * math.sqrt((rows[1] ** 2).sum(1).mean() / (rows[0] ** 2).sum(1).mean())
    fitted = m @ w, m @ (b - x.mean(0)) + y.mean(0)
    mapped = (rows[0] - x.mean(0)) @ m.T + y.mean(0)
    times = 0.25 * rms(rows[1]) / rms(mapped)
    turn = np.linalg.qr(rng.standard_normal((d, d)))[0]
    made = {
        "reinit": None,
        "pad": (grown[0] * by, grown[1] * by),
        "fit": (fitted[0] * times, fitted[1] * times),
        "rotated": (turn @ fitted[0] * times, turn @ fitted[1] * times),
    }
    return made, dict(words=len(shared), cosine=round(best[0], 3), ridge=best[1])


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("texts", type=Path)
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--pairs", type=int, default=1)
    p.add_argument("--steps", type=int, default=1500)
    p.add_argument("--most", type=int, default=400, help="steps after which a start has not reached a goal")
    p.add_argument("--out", type=Path)
    a = p.parse_args()
    torch.set_num_threads(1)
    texts = [
        f.read_text(errors="replace")
        for f in sorted(a.texts.rglob("*"))
        if f.suffix in (".md", ".rst", ".txt") and f.stat().st_size < 200_000
    ]
    chunks = [t[i : i + 400] for t in texts for i in range(0, len(t), 400)]
    random.Random(a.seed).shuffle(chunks)
    chunks = chunks[:6000]
    found = []
    for pair in range(a.pairs):
        seed, began = a.seed + 100 * pair, time.time()
        third = len(chunks) // 3
        prose = chunks[: 2 * third], chunks[third:]
        rng = random.Random(seed)
        some = [[document(rng, own) for _ in range(4000)] for own in prose]
        cores = tokenizer(some[0], 1500), tokenizer(some[1], 2000)
        (one, l1), (two, l2) = (
            speak(c, d, own, seed + i, a.steps) for i, (c, d, own) in enumerate(zip(cores, (96, 160), prose, strict=True))
        )
        print(f"pair {seed}: loss {l1:.2f} and {l2:.2f}, {time.time() - began:.0f} s", flush=True)
        tower = Tower(seed)
        with torch.no_grad():
            draw = torch.Generator().manual_seed(9)
            blind = statistics.mean(show(two, None, *batch(cores[1], random.Random(i), tower, draw)).item() for i in range(8))
            able = restated(two, cores[1])
        print(f"pair {seed}: without a picture {blind:.2f}; restates text with a loss of {able:.3f}", flush=True)
        for model in (one, two):
            model.requires_grad_(False)
        projector = nn.Linear(FEATURES, 96)
        losses = train(one, projector, cores[0], tower, seed, 1000)
        for host in ("frozen", "joint"):
            if host == "joint":
                one.requires_grad_(True)
                losses = train(one, projector, cores[0], tower, seed + 1, 400, also=one.parameters(), rate=5e-4)
                one.requires_grad_(False)
            made, known = starts(projector, one, two, cores, seed)
            print(
                f"pair {seed} {host}: the host's loss is {statistics.mean(losses[-50:]):.3f}; {known}, {time.time() - began:.0f} s",
                flush=True,
            )
            for name, values in made.items():
                for order in range(3):
                    torch.manual_seed(seed + order)
                    new = nn.Linear(FEATURES, 160)
                    if values is not None:
                        with torch.no_grad():
                            new.weight.copy_(torch.from_numpy(values[0]))
                            new.bias.copy_(torch.from_numpy(values[1]))
                    curve = train(two, new, cores[1], tower, 1000 * seed + order, a.most, stop=GOALS[-1])
                    mean = [statistics.mean(curve[max(0, i - 4) : i + 1]) for i in range(len(curve))]
                    reached = [next((i for i, m in enumerate(mean) if i > 3 and m < goal), None) for goal in GOALS]
                    found.append(dict(pair=seed, host=host, start=name, order=order, first=curve[0], reached=reached))
                own = [f["reached"] for f in found if (f["pair"], f["host"], f["start"]) == (seed, host, name)]
                print(f"pair {seed} {host} {name}: steps to {GOALS}: {list(zip(*own, strict=True))}", flush=True)
    if a.out:
        a.out.write_text("".join(json.dumps(f) + "\n" for f in found))


def restated(model, core):
    """The loss of a caption behind a text that lists the scene: what the model can do with a perfect picture."""
    rng, losses = random.Random(5), []
    for _ in range(64):
        s = scene(rng)
        start = len(core.encode(listed(s) + "\n").ids)
        ids = torch.tensor([core.encode(listed(s) + "\n" + told(s) + "\n").ids])
        logits = model(model.embed(ids))[0, start - 1 : -1]
        losses.append(F.cross_entropy(logits, ids[0, start:]).item())
    return statistics.mean(losses)


if __name__ == "__main__":
    main()
