#!/usr/bin/env python3
"""What the tool says of the files of a diffusers pipeline, compared with what DiffusionPipeline does with them.

    pipelines.py [SEED] [COUNT]        COUNT damaged pipelines (default 120)

A small pipeline is saved, and files of it are removed, renamed to variants or misspelt. A directory that raises without a
finding fails, and so does a finding on one that opens.
"""

import json
import random
import shutil
import sys

import diffusers
from peer import Tally, check, workplace

RULES = {"DIR010", "DIR011", "DIR012", "DIR013"}
WEIGHTS = "diffusion_pytorch_model.safetensors"


def save(folder, pickled):
    """A pipeline of two models and a scheduler, with weights in one of the two formats."""
    unet = diffusers.UNet2DModel(
        sample_size=8,
        in_channels=6,
        out_channels=3,
        layers_per_block=1,
        block_out_channels=(8, 8),
        norm_num_groups=4,
        down_block_types=("DownBlock2D", "DownBlock2D"),
        up_block_types=("UpBlock2D", "UpBlock2D"),
    )
    vqvae = diffusers.VQModel(block_out_channels=(8,), latent_channels=3, num_vq_embeddings=8, norm_num_groups=4, sample_size=8)
    pipeline = diffusers.LDMSuperResolutionPipeline(vqvae=vqvae, unet=unet, scheduler=diffusers.DDIMScheduler())
    pipeline.save_pretrained(folder, safe_serialization=not pickled)


def damage(rng, folder):
    """Changes one to three things; returns what."""
    weights = sorted(folder.glob("*/diffusion_pytorch_model.*"))
    part = rng.choice(("unet", "vqvae", "scheduler"))
    done = []
    for kind in rng.sample(
        ("none", "weights", "variant", "both", "folder", "index", "null", "misspelt", "empty", "other"), rng.choice((1, 1, 2))
    ):
        file = rng.choice([w for w in weights if w.exists()] or [None])
        if kind == "weights" and file:
            file.unlink()
        elif kind == "variant" and file:
            file.rename(file.with_name(file.name.replace("model.", f"model.{rng.choice(('fp16', 'bf16', 'non_ema'))}.")))
        elif kind == "both" and file:
            shutil.copy(file, file.with_name(file.name.replace("model.", "model.fp16.")))
        elif kind == "folder" and (folder / part).exists():
            shutil.rmtree(folder / part)
        elif kind == "empty" and (folder / part).exists():
            shutil.rmtree(folder / part)
            (folder / part).mkdir()
        elif kind == "index" and (folder / "model_index.json").exists():
            (folder / "model_index.json").unlink()
        elif kind == "null" and (folder / "model_index.json").exists() and part != "scheduler":
            index = json.loads((folder / "model_index.json").read_text())
            index["safety_checker"] = [None, None]
            (folder / "model_index.json").write_text(json.dumps(index))
        elif kind == "misspelt" and file:
            file.rename(file.with_name(rng.choice(("model", "weights")) + file.suffix))
        elif kind == "other" and file:
            (file.parent / "notes.txt").write_text("x")
        else:
            continue
        done.append(f"{kind} {file.parent.name if file else part}" if kind not in ("folder", "empty") else f"{kind} {part}")
    return done


def opens(folder):
    try:
        diffusers.DiffusionPipeline.from_pretrained(folder, local_files_only=True, low_cpu_mem_usage=False)
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:110]}"
    return None


def main():
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 0
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 120
    diffusers.utils.logging.set_verbosity(diffusers.utils.logging.CRITICAL)
    diffusers.utils.logging.disable_progress_bar()
    tally, rng = Tally(), random.Random(seed)
    raising = 0
    with workplace() as work:
        for pickled in (False, True):
            save(work / f"sound-{pickled}", pickled)
        for number in range(count):
            folder = work / str(number)
            shutil.copytree(work / f"sound-{rng.random() < 0.3}", folder)
            done = damage(rng, folder)
            found = sorted({f["code"] for c in check(folder)[0].values() for f in c["findings"]} & RULES)
            error = opens(folder)
            if not (folder / "model_index.json").exists() and any(
                not any(folder.glob(f"{p}/*.json")) for p in ("unet", "scheduler")
            ):
                continue  # nothing shows that this was a pipeline
            raising += error is not None
            tally.equal(bool(found), error is not None, f"{number} ({', '.join(done)}): {error or 'opens'}; found {found}")
    tally.expect(count // 4 < raising < count, "pipelines that raise", raising)
    tally.finish()


if __name__ == "__main__":
    main()
