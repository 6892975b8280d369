//! Names in an adapter's file.

use crate::checkpoint::adapter::PREFIX;

/// The part that a tensor has in its module.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum MatrixRole {
    A,
    B,
    /// `lora_B.bias`, with `lora_bias`.
    Bias,
    EmbeddingA,
    EmbeddingB,
    /// The vector of lengths that DoRA adds.
    Magnitude,
}

impl MatrixRole {
    /// How names spell it.
    pub(super) const fn word(self) -> &'static str {
        match self {
            Self::A => "lora_A",
            Self::B => "lora_B",
            Self::Bias => "lora_B.bias",
            Self::EmbeddingA => "lora_embedding_A",
            Self::EmbeddingB => "lora_embedding_B",
            Self::Magnitude => "lora_magnitude_vector",
        }
    }
}

/// A tensor's name, taken apart.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum AdapterKey<'n> {
    /// A tensor of a LoRA, and the base model's module it belongs to.
    Lora { module: &'n str, role: MatrixRole },
    /// The same with the name of the adapter `default`, which PEFT 0.21 loads and older versions drop.
    Named { module: &'n str, role: MatrixRole },
    /// A tensor of the base model, stored whole: an embedding, a trained bias, one of `modules_to_save`.
    Whole(&'n str),
    /// PEFT finds no place for it, for this reason.
    Foreign(&'static str),
}

/// Endings of the saved form, which has no adapter's name in it.
const ENDINGS: [(&str, MatrixRole); 7] = [
    (".lora_A.weight", MatrixRole::A),
    (".lora_B.weight", MatrixRole::B),
    (".lora_B.bias", MatrixRole::Bias),
    (".lora_embedding_A", MatrixRole::EmbeddingA),
    (".lora_embedding_B", MatrixRole::EmbeddingB),
    (".lora_magnitude_vector", MatrixRole::Magnitude),
    (".lora_magnitude_vector.weight", MatrixRole::Magnitude),
];

/// Endings in a state dict of the model, of an adapter that is called `default`.
const NAMED_ENDINGS: [(&str, MatrixRole); 4] = [
    (".lora_A.default.weight", MatrixRole::A),
    (".lora_B.default.weight", MatrixRole::B),
    (".lora_embedding_A.default", MatrixRole::EmbeddingA),
    (".lora_embedding_B.default", MatrixRole::EmbeddingB),
];

impl<'n> AdapterKey<'n> {
    pub(super) fn parse(name: &'n str) -> Self {
        let Some(bare) = name.strip_prefix(PREFIX) else {
            return Self::Foreign("it does not start with base_model.model.");
        };
        let of = |endings: &[(&str, MatrixRole)]| {
            endings.iter().find_map(|(end, role)| Some((bare.strip_suffix(end)?, *role)))
        };
        if let Some((module, role)) = of(&ENDINGS) {
            return Self::Lora { module, role };
        }
        if let Some((module, role)) = of(&NAMED_ENDINGS) {
            return Self::Named { module, role };
        }
        // Variants of LoRA (`lora_ga`, `lora_sparse…`) have tensors of their own; only what is plainly misspelled counts.
        let named = ["lora_A", "lora_B", "lora_embedding_A", "lora_embedding_B"].into_iter().any(|word| {
            bare.split_once(&format!(".{word}."))
                .is_some_and(|(_, rest)| word.contains("embedding") || rest.contains('.'))
        });
        if named { Self::Foreign("its name contains the name of an adapter") } else { Self::Whole(bare) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_say_module_and_role() {
        let lora = |module, role| AdapterKey::Lora { module, role };
        for (name, key) in [
            ("base_model.model.h.0.c_attn.lora_A.weight", lora("h.0.c_attn", MatrixRole::A)),
            ("base_model.model.h.0.c_attn.lora_B.bias", lora("h.0.c_attn", MatrixRole::Bias)),
            ("base_model.model.wte.lora_embedding_B", lora("wte", MatrixRole::EmbeddingB)),
            ("base_model.model.q.lora_magnitude_vector", lora("q", MatrixRole::Magnitude)),
            ("base_model.model.lm_head.weight", AdapterKey::Whole("lm_head.weight")),
            ("base_model.model.q.lora_A.default.weight", AdapterKey::Named { module: "q", role: MatrixRole::A }),
            ("base_model.model.q.lora_A.mine.weight", AdapterKey::Foreign("its name contains the name of an adapter")),
            (
                "base_model.model.wte.lora_embedding_A.mine",
                AdapterKey::Foreign("its name contains the name of an adapter"),
            ),
            ("h.0.c_attn.lora_A.weight", AdapterKey::Foreign("it does not start with base_model.model.")),
        ] {
            assert_eq!(AdapterKey::parse(name), key, "{name}");
        }
    }
}
