//! What is said of `generation_config.json`, by version.

use std::sync::Arc;

use ckpt_doctor::check::check_for;
use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::check::verdict::LoadVerdict::{self, Loads, NotPredicted, Raises};
use ckpt_doctor::checkpoint::{Checkpoint, MemoryFiles, Source};
use serde_json::json;

use crate::support::knowledge;

/// The verdicts on the generation config and on the model, and the pointers of GEN004 and GEN007.
fn judged(generation: &str, class: &str, version: &str) -> (LoadVerdict, LoadVerdict, Vec<String>) {
    let config = json!({ "architectures": [class], "model_type": "llama", "transformers_version": version });
    let files = [("config.json", config.to_string()), ("generation_config.json", generation.to_owned())];
    let files = files.map(|(name, text)| (name.to_owned(), text.into_bytes()));
    let checkpoint = Checkpoint::read(Source::Memory(MemoryFiles::new("model", files))).unwrap();
    let outcome = check_for(&Arc::new(checkpoint), &knowledge(), &RunOptions::for_versions(&[version.to_owned()]));
    let load = &outcome.verdicts[0];
    let of = |name: &str| load.objects.iter().find(|object| object.object.name() == name).unwrap();
    let is_own = |code: &str| matches!(code, "GEN004" | "GEN007");
    let findings = outcome.findings.iter().filter(|finding| is_own(&finding.code));
    let pointers = findings.flat_map(|finding| &finding.locations).filter_map(|place| place.pointer.clone()).collect();
    // The model has no weights here, and raises for that.
    let model = of("model").findings.iter().any(|code| is_own(code));
    (of("generation").verdict, if model { Raises } else { Loads }, pointers)
}

/// The cases of transformers 4.47.0, 4.57.6 and 5.23.0, which `tests/peer/generation.py` opens.
#[test]
fn a_generation_config_loads_as_its_version_reads_it() {
    for (generation, verdicts) in [
        ("{}", [Loads, Loads, Loads]),
        (r#"{ "eos_token_id": [1, 2], "temperature": null, "made_by": "hand" }"#, [Loads, Loads, Loads]),
        (r#"{ "cache_implementation": "dynamic" }"#, [Raises, Loads, Loads]),
        (r#"{ "max_new_tokens": 0 }"#, [Raises, Raises, Raises]),
        (r#"{ "early_stopping": null }"#, [Raises, Raises, Loads]),
        (r#"{ "streamer": null }"#, [Raises, Raises, Raises]),
        (r#"{ "streamer": null, "_from_model_config": true }"#, [Loads, Loads, Loads]),
        (r#"{ "num_return_sequences": 2 }"#, [Raises, Raises, Raises]),
        (r#"{ "num_return_sequences": 0 }"#, [Raises, Raises, Loads]),
        (r#"{ "num_return_sequences": 2, "do_sample": true }"#, [Loads, Loads, Loads]),
        (r#"{ "num_return_sequences": 2, "do_sample": null }"#, [Loads, Loads, Raises]),
        (r#"{ "num_return_sequences": 2, "num_beams": 2 }"#, [Loads, Loads, Loads]),
        (r#"{ "num_return_sequences": 3, "num_beams": 2, "do_sample": true }"#, [Raises, Raises, Raises]),
        (r#"{ "num_return_sequences": 2, "num_beams": null, "do_sample": true }"#, [Loads, Raises, Loads]),
        (r#"{ "num_return_sequences": "2", "do_sample": true }"#, [Loads, Loads, Raises]),
        (r#"{ "num_beams": 4, "num_beam_groups": 2 }"#, [Raises, Loads, Loads]),
        (r#"{ "num_beams": 4, "num_beam_groups": 3, "diversity_penalty": 0.5 }"#, [Raises, Loads, Loads]),
        (r#"{ "num_beams": 4, "num_beam_groups": 2, "diversity_penalty": 0.5 }"#, [Loads, Loads, Loads]),
        (r#"{ "num_beams": 4, "force_words_ids": [[5]], "do_sample": true }"#, [Raises, Loads, Loads]),
        (r#"{ "suppress_tokens": [5, 6], "forced_eos_token_id": 5 }"#, [Loads, Loads, Raises]),
        (r#"{ "suppress_tokens": [5, 6], "forced_eos_token_id": [5, 7] }"#, [Loads, Loads, Loads]),
        (r#"{ "suppress_tokens": [5, 6], "forced_eos_token_id": 5.0 }"#, [Loads, Loads, Raises]),
        // Python reads NaN as a number, which is not above 0 and not below.
        (r#"{ "max_new_tokens": NaN }"#, [NotPredicted, NotPredicted, NotPredicted]),
        (r#"{ "temperature": NaN }"#, [Loads, Loads, Loads]),
        (r#"{ "watermarking_config": {} }"#, [Loads, Loads, Loads]),
        (r#"{ "num_beams": "4" }"#, [Loads, Loads, Loads]),
        (r#"{ "num_beams": "4", "num_beam_groups": 2, "do_sample": true }"#, [Raises, Loads, Loads]),
        (r#"{ "num_return_sequences": [1], "num_beams": [2] }"#, [NotPredicted, NotPredicted, Raises]),
    ] {
        for (version, verdict) in ["4.47.0", "4.57.6", "5.23.0"].into_iter().zip(verdicts) {
            let (generation_verdict, model, pointers) = judged(generation, "LlamaForCausalLM", version);
            assert_eq!(generation_verdict, verdict, "{version}: {generation} {pointers:?}");
            assert_eq!(model == Raises, verdict == Raises, "{version}: {generation}");
            assert_eq!(pointers.is_empty(), verdict != Raises, "{version}: {generation} {pointers:?}");
        }
    }
}

/// Lists are compared as sets: in no more work than their length.
#[test]
fn long_lists_of_tokens_are_compared() {
    let ids: Vec<u64> = (0..30_000).collect();
    let forced: Vec<u64> = ids.iter().rev().copied().collect();
    let both = json!({ "suppress_tokens": ids, "forced_eos_token_id": forced }).to_string();
    let (verdict, _, pointers) = judged(&both, "LlamaForCausalLM", "5.23.0");
    assert_eq!((verdict, pointers), (Raises, vec!["/forced_eos_token_id".to_owned()]));
}

/// A class that cannot generate does not read the file; `GenerationConfig` refuses it all the same.
#[test]
fn a_model_that_does_not_generate_loads_beside_a_generation_config_that_does_not() {
    let (generation, model, pointers) = judged(r#"{ "max_new_tokens": -1 }"#, "LlamaModel", "4.57.6");
    assert_eq!((generation, model), (Raises, Loads));
    assert_eq!(pointers, ["/max_new_tokens"]);
}

/// Between two known versions, only what both refuse is refused, and only what both accept is accepted.
#[test]
fn a_version_between_two_others_may_do_as_either() {
    for (generation, verdict) in [
        (r#"{ "cache_implementation": "dynamic" }"#, NotPredicted),
        (r#"{ "max_new_tokens": 0 }"#, Raises),
        (r#"{ "num_beams": 4, "num_beam_groups": 2 }"#, NotPredicted),
        (r#"{ "num_beams": 4 }"#, Loads),
    ] {
        assert_eq!(judged(generation, "LlamaForCausalLM", "4.50.0").0, verdict, "{generation}");
    }
}
