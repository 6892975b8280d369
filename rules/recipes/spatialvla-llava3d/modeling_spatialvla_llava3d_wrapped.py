"""SpatialVLA's model class in the wrapped layout: the language model one level deeper, the projector a bare Linear.

    language_model.model.model.layers.N.*      language_model.model.lm_head.weight
    multi_modal_projector.weight               multi_modal_projector.bias

The layout supports neither spatial tokens nor a depth network: SpatialVLA's hook after loading expects the embedding
one level higher.
"""

from torch import nn
from transformers import AutoModelForCausalLM

# transformers copies only the files that this module imports directly. modeling_spatialvla.py imports the first two;
# without these lines they would not be copied, and loading would raise FileNotFoundError.
from .configuration_spatialvla import SpatialVLAConfig  # noqa: F401
from .modeling_gemma2 import Gemma2ForCausalLM  # noqa: F401
from .modeling_spatialvla import SpatialVLAForConditionalGeneration as _SpatialVLA


class WrappedLanguageModel(nn.Module):
    """A causal language model in the attribute `.model`; forwards all attributes that SpatialVLA uses."""

    def __init__(self, model):
        super().__init__()
        self.model = model
        self.config = model.config
        tied = model._tied_weights_keys
        self._tied_weights_keys = tied and [f"model.{key}" for key in tied]

    def forward(self, *args, **kwargs):
        return self.model(*args, **kwargs)

    def prepare_inputs_for_generation(self, *args, **kwargs):
        return self.model.prepare_inputs_for_generation(*args, **kwargs)

    def get_input_embeddings(self):
        return self.model.get_input_embeddings()

    def set_input_embeddings(self, value):
        self.model.set_input_embeddings(value)

    def get_output_embeddings(self):
        return self.model.get_output_embeddings()

    def set_output_embeddings(self, value):
        self.model.set_output_embeddings(value)

    def get_decoder(self):
        return self.model.get_decoder()

    def set_decoder(self, decoder):
        self.model.set_decoder(decoder)

    def resize_token_embeddings(self, *args, **kwargs):
        return self.model.resize_token_embeddings(*args, **kwargs)

    def tie_weights(self):
        return self.model.tie_weights()


class SpatialVLAForConditionalGeneration(_SpatialVLA):
    def __init__(self, config, vision_model=None, vision_zoe_model=None, projector_model=None, language_model=None):
        if config.use_spatial_token or config.use_vision_zoe:
            raise ValueError("the wrapped layout needs use_spatial_token and use_vision_zoe to be false")
        if language_model is None:
            language_model = WrappedLanguageModel(AutoModelForCausalLM.from_config(config.text_config))
        if projector_model is None:
            vision = config.vision_config
            projector_model = nn.Linear(vision.hidden_size, vision.projection_dim)
        super().__init__(config, vision_model, vision_zoe_model, projector_model, language_model)
