//! Adapters under versions of PEFT that the user names.

use std::sync::Arc;

use ckpt_doctor::check::check_for;
use ckpt_doctor::check::finding::{Finding, Severity};
use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::checkpoint::Checkpoint;

use crate::support::{knowledge, made};

/// The findings on the keys of an adapter of PEFT 0.18.1 whose newer keys hold their defaults.
fn of_keys(versions: &[&str]) -> Vec<Finding> {
    let room = tempfile::tempdir().expect("a directory");
    let changes = r#"[
        { set: { file: "adapter_config.json", at: "/corda_config", to: null } },
        { set: { file: "adapter_config.json", at: "/lora_bias", to: false } },
        { set: { file: "adapter_config.json", at: "/peft_version", to: "0.18.1" } },
    ]"#;
    let checkpoint = Arc::new(Checkpoint::open(made("lora", changes, room.path())).expect("a directory"));
    let versions: Vec<String> = versions.iter().map(|version| (*version).to_owned()).collect();
    let outcome = check_for(&checkpoint, &knowledge(), &RunOptions::for_versions(&versions));
    outcome.findings.into_iter().filter(|finding| finding.code == "ADP016").collect()
}

#[test]
fn unknown_keys_are_an_error_under_versions_that_raise() {
    for (version, severity) in [
        ("peft==0.5.0", Some(Severity::Info)),
        ("peft==0.6.0", Some(Severity::Error)),
        ("peft==0.13.2", Some(Severity::Error)),
        ("peft==0.15.1", Some(Severity::Info)),
        ("peft==0.18.1", None),
        ("peft==99.0", None),
    ] {
        assert_eq!(of_keys(&[version]).first().map(|finding| finding.severity), severity, "{version}");
    }
}

#[test]
fn the_exception_names_the_first_key_and_the_version() {
    let findings = of_keys(&["peft==0.13.1", "4.57.6"]);
    let effect = &findings[0].effects[0];
    assert_eq!(
        effect.text,
        "TypeError: LoraConfig.__init__() got an unexpected keyword argument 'corda_config' (PEFT 0.13.1)"
    );
    assert_eq!(effect.loader, "4.57.6", "the version of PEFT is none of transformers");
}
