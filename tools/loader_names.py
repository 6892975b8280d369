#!/usr/bin/env python3
"""Write the names that the transformers at hand accepts in config.json to rules/names.json. For maintainers.

python tools/loader_names.py            # replace the lists of this version
python tools/loader_names.py --check    # fail if the lists of this version differ
"""

import json
import sys
from pathlib import Path

import torch
import transformers
from transformers.activations import ACT2FN
from transformers.modeling_rope_utils import ROPE_INIT_FUNCTIONS
from transformers.models.auto.configuration_auto import CONFIG_MAPPING_NAMES
from transformers.models.auto.feature_extraction_auto import FEATURE_EXTRACTOR_MAPPING_NAMES
from transformers.models.auto.image_processing_auto import IMAGE_PROCESSOR_MAPPING_NAMES
from transformers.models.auto.processing_auto import PROCESSOR_MAPPING_NAMES
from transformers.quantizers.auto import AUTO_QUANTIZATION_CONFIG_MAPPING

from by_version import keep

FILE = Path(__file__).resolve().parents[1] / "rules" / "names.json"


def main():
    lists = {
        "activations": sorted(ACT2FN),
        "dtypes": sorted(name for name, value in vars(torch).items() if isinstance(value, torch.dtype)),
        "model_types": sorted(CONFIG_MAPPING_NAMES),
        # Model types whose processor has an image processor or a feature extractor.
        "processors": sorted(set(PROCESSOR_MAPPING_NAMES) & {*IMAGE_PROCESSOR_MAPPING_NAMES, *FEATURE_EXTRACTOR_MAPPING_NAMES}),
        "quantization": sorted(AUTO_QUANTIZATION_CONFIG_MAPPING),
        # `default` has no function of its own in transformers 5, which all the same takes it.
        "rope_types": sorted({*ROPE_INIT_FUNCTIONS, "default"}),
    }
    return keep(FILE, transformers.__version__, lists, listed)


def listed(lists):
    return ",\n".join(f"    {json.dumps(name)}: [\n{wrapped(names)}\n    ]" for name, names in lists.items())


def wrapped(names, width=118):
    """JSON strings in lines of at most `width` columns."""
    lines = ["     "]
    for at, name in enumerate(names):
        item = f" {json.dumps(name)}" + ("," if at + 1 < len(names) else "")
        if len(lines[-1]) + len(item) > width:
            lines.append("     ")
        lines[-1] += item
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
