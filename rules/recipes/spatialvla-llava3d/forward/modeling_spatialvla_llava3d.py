"""SpatialVLA's model class with the language model of `text_config`.

SpatialVLA builds a Gemma 2 unless a language model is passed to it; this class passes one. Tensor names, the forward
pass and the hook after loading are those of SpatialVLA.
"""

from transformers import AutoModelForCausalLM

from {{package}}.modeling_spatialvla import SpatialVLAForConditionalGeneration as _SpatialVLA

# AutoModel compares this class with the one that AutoConfig builds from config.json.
from .configuration_spatialvla_llava3d import SpatialVLAConfig


class SpatialVLAForConditionalGeneration(_SpatialVLA):
    config_class = SpatialVLAConfig

    def __init__(self, config, vision_model=None, vision_zoe_model=None, projector_model=None, language_model=None):
        language_model = language_model or AutoModelForCausalLM.from_config(config.text_config)
        super().__init__(config, vision_model, vision_zoe_model, projector_model, language_model)
