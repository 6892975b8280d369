"""Which classes there are: those of transformers' auto mappings, and those it exports besides, by their config class."""

import collections
import re

import transformers
from transformers.models.auto import modeling_auto
from transformers.models.auto.configuration_auto import CONFIG_MAPPING, CONFIG_MAPPING_NAMES

VERSION = transformers.__version__

# Model types that users meet, most wanted first: they are sampled first, so that an interrupted run has them.
IMPORTANT = """llama mistral mixtral gemma gemma2 gemma3 gemma3_text gemma3n gemma3n_text qwen2 qwen2_moe qwen2_vl qwen2_5_vl qwen3 qwen3_moe
qwen3_vl qwen3_vl_moe phi phi3 siglip siglip_vision_model siglip_text_model clip clip_vision_model clip_text_model llava llava_next
llava_onevision paligemma zoedepth whisper bert vit dinov2 sam sam_vision_model swin wav2vec2 roberta t5 gpt2 gpt_neox gpt_neo gptj falcon
opt bloom mpt deepseek_v2 deepseek_v3 cohere cohere2 idefics idefics2 idefics3 smolvlm internvl internvl_vision mistral3 ministral3 pixtral
mllama mllama_text_model mllama_vision_model gpt_oss olmo olmo2 olmoe stablelm starcoder2 granite granitemoe glm glm4 glm4v glm4_moe
xlm-roberta deberta deberta-v2 electra distilbert albert mpnet modernbert mamba mamba2 jamba bart mbart blip blip-2 instructblip
depth_anything dpt beit convnext convnextv2 resnet detr swinv2 deit hubert clap chameleon video_llava vipllava fuyu phimoe dbrx nemotron
siglip2 siglip2_vision_model dinov3_vit falcon_mamba recurrent_gemma codegen gpt_bigcode mt5 umt5 longt5 pegasus marian m2m_100 blenderbot
led longformer big_bird camembert xlm xlnet funnel layoutlm layoutlmv3 dinov2_with_registers sam2 sam_hq wavlm data2vec-audio data2vec-text
data2vec-vision speecht5 musicgen segformer mask2former maskformer oneformer owlvit owlv2 grounding-dino vitmatte upernet table-transformer
rt_detr yolos florence2 qwen2_audio qwen2_5_omni qwen3_omni_moe llama4 llama4_text kosmos-2 aria moonshine bamba zamba zamba2 smollm3
hunyuan_v1_dense ernie4_5 lfm2 minimax exaone4 seed_oss""".split()


def mappings():
    """{mapping name, as in `auto` of the architecture files: {model_type: [class names]}}."""
    out = {}
    for name, table in sorted(vars(modeling_auto).items()):
        if name.startswith("MODEL_") and name.endswith("MAPPING_NAMES") and isinstance(table, dict):
            short = (
                name.removesuffix("_MAPPING_NAMES").removeprefix("MODEL").removeprefix("_FOR_").strip("_").lower() or "model"
            )
            out[short] = {mt: [n for n in (c if isinstance(c, (list, tuple)) else [c]) if n] for mt, c in table.items()}
    return out


def config_class(model_type):
    """The config class of a model type, or None where it cannot be imported."""
    try:
        return CONFIG_MAPPING[model_type]
    except Exception:  # lazily imported: whatever the module raises
        return None


def families():
    """[(config class, model_type, [class names])]: important ones first, the class without a head first in each.

    Classes of the mappings are only named here: each is imported when its turn comes."""
    by_type = collections.defaultdict(dict)
    for short, table in sorted(
        mappings().items(), key=lambda kv: (kv[0] not in ("model", "backbone"), kv[0] == "backbone", kv[0])
    ):
        for mt, names in table.items():
            for n in names:
                by_type[mt].setdefault(n, short)
    for mt, name in exported({n for names in by_type.values() for n in names}):
        by_type[mt].setdefault(name, "exported")
    rank = {mt: i for i, mt in enumerate(IMPORTANT)}
    out, seen = [], set()
    for mt in sorted(by_type, key=lambda m: (rank.get(m, len(rank)), m)):
        names = [n for n in by_type[mt] if n not in seen]
        seen.update(names)
        if names and mt in CONFIG_MAPPING_NAMES:
            out.append((mt, names))
    return out


MODEL = re.compile(r"(Model|Backbone|WithProjection)$|For[A-Z]|LMHead|DoubleHeads")
NO_MODEL = re.compile(r"^(TF|Flax|Auto)|Pre[tT]rained|Config$|Processor|Collator|DataFormat|Dataset|Extractor|Output$|Criteria")


def exported(mapped):
    """(model_type, class) of the model classes that transformers exports and no mapping names: parts, and other heads."""
    for name in sorted(dir(transformers)):
        if name in mapped or not MODEL.search(name) or NO_MODEL.search(name):
            continue
        try:
            cls = getattr(transformers, name)
            mt = cls.config_class.model_type
        except Exception:  # it wants a library that is not there, or is no model
            continue
        if mt in CONFIG_MAPPING_NAMES and issubclass(cls, transformers.PreTrainedModel):
            yield mt, name


def find_class(name):
    """A model class by its name, also one that transformers does not export at its top."""
    return getattr(transformers, name)
