"""What config keys are about, by their names."""

import re

# Keys that never decide a name or a shape: no samples are spent on them, and no expression may use them.
NOISE = re.compile(
    r"(token_id|token_index|token_ids)$|^(bos|eos|pad|cls|sep|unk|mask)_token$|dropout|drop_|initializer|_eps$|epsilon|^use_cache|dtype"
    r"|transformers_version|name_or_path|architectures|label2id|id2label|rope_(theta|type|scaling)|rope_param|temperature|_coef|coefficient"
    r"|mask_time|mask_feature|^num_beams|chunk_size_feed|problem_type|return_dict|output_(hidden_st|att|sco)|^ctc_|finetuning|loss"
    r"|torchscript|pruned|min_length|^top_[kp]|penalty|diversity|suppress|^begin_|num_return|(^|_)sampling_rate|tokenizer_class|^prefix$|attn_implementation"
    r"|model_type$|task_specific|keys_to_ignore|tf_legacy|use_bfloat|remove_invalid|early_stopping"
    r"|gradient_check|^base_model_(tp|pp)|logit_scale|softcap|_multiplier$|init_std|init_range|_init$|^training|^chunk_length|transformers_weights"
)

# What a key is about, by its name.
LAYERS = re.compile(
    r"(.*_)?(num_hidden_layers|n_layers?|num_layers|layers|depth|num_hidden_groups|num_blocks|resampler_depth|num_adapter_layers)$"
)
HEADS = re.compile(r"(.*_)?(num_attention_heads|n_heads?|num_heads|attention_heads|heads)$")
KV_HEADS = re.compile(r"(.*_)?(num_key_value_heads|num_kv_heads|n_head_kv|n_kv_heads)$")
WIDTH = re.compile(
    r"(hidden_size|d_model|n_embd|dim|embed_dim|emb_dim|hidden_dim|(en|de)coder_hidden_size|hidden_size_global|width)$"
)
HEAD_WIDTH = re.compile(r"(.*_)?(head_dim|d_kv|attention_head_size)$")
INNER = re.compile(
    r"(.*_)?(intermediate_size|ffn_dim|mlp_dim|d_ff|d_inner|n_inner|ffn_hidden_size|feedforward_dim|ff_dim|dim_feedforward)$"
)
VOCAB = re.compile(r"(.*_)?vocab_size$|vocab_size_.*")
POSITIONS = re.compile(
    r"(max_position_embeddings|n_positions|max_(source|target|text|speech)_positions|max_seq_len(gth)?|seq_length|n_ctx)$"
)
EXPERTS = re.compile(r"(num_experts|num_local_experts|n_routed_experts|moe_num_experts)$")
PER_TOKEN = re.compile(r"(num_experts_per_tok(en)?|moe_topk|moe_top_k|moe_k)$")
SMALL = re.compile(
    r"(.*_)?(lora_rank|rope_head_dim|nope_head_dim|v_head_dim|projection_dim|output_dim|embedding_size|d_state|state_size"
    r"|classifier_proj_size|fusion_hidden_size|bottleneck_features|num_queries|codevector_dim|embd_pdim|proj_dim)$"
)
FLAG = re.compile(
    r"bias|^tie_|norm|^use_|rel_pos|abs_pos|mask_token|adapter|gated|parallel|pool|multi_query|share|swiglu|projection|k_eq_v|relative|alibi"
    r"|new_decoder|distill|head|attention|conv|gate|position|embed|proj|^add_|^has_|^is_|^with_"
)
FIXED_FLAG = re.compile(
    r"use_cache|torchscript|pretrained|timm|kernels|bfloat|prune|tf_|return|^output_(hid|att)|is_composition|use_mems|flash|triton|mask_time"
)
RATIO = re.compile(r"ratio|expan|factor|mult|width|alpha|scale|fraction")
SIZES = re.compile(r"hidden|channel|dim|size|width|embed|filters|planes")
OPTIONAL = re.compile(
    r"dim|size|heads|rank|inner|num_|layers|experts|hidden|channel|width|shared|interval|freq|period|n_|length|stride"
)
