//! `let` in rules, by rules of a user on a sound model.

use crate::support::{knowledge, look, made};

/// The messages of a rule with these keys, why it was skipped, and whether the run is refused because of it.
fn outcome(changes: &str, keys: &str) -> (Vec<String>, Vec<String>, bool) {
    let text = format!("{{ code: 'ABC001', name: 'a-b', summary: 's', why: 'w', severity: 'info', {keys} }}");
    let mut knowledge = knowledge();
    let files = [("ABC001.json5".to_owned(), text.as_str())];
    knowledge.rules = knowledge.rules.and_files(files).unwrap_or_else(|error| panic!("{error}"));
    let room = tempfile::tempdir().expect("a folder");
    let outcome = look(&made("llama", changes, room.path()), false, &knowledge);
    let own = |code: &str| code == "ABC001";
    let messages = outcome.findings.iter().filter(|f| own(&f.code)).map(|f| f.message.clone()).collect();
    let skipped = outcome.skipped.iter().filter(|s| own(&s.code)).map(|s| s.why.clone()).collect();
    (messages, skipped, outcome.unusable.iter().any(|s| own(&s.code)))
}

fn messages(keys: &str) -> Vec<String> {
    outcome("[]", keys).0
}

#[test]
fn names_of_the_rule_are_seen_everywhere_below() {
    let keys = "let: { base: 'tokenizer.length * 0', one: 'base + 1' }, when: 'true', check: { assert: { each: '[one, one + 1]', \
                that: 'it == one', at: [{ file: 'config.json', pointer: '/{one}' }] } }, message: '{base} {it}'";
    assert_eq!(messages(keys), ["0 2"]);
}

#[test]
fn names_of_a_check_are_those_of_each_element() {
    let keys = "check: { assert: { each: '[2, 3]', let: { twice: 'it * 2', more: 'twice + 1' }, that: 'more > 5' } }, \
                message: '{it} {twice} {more}'";
    assert_eq!(messages(keys), ["2 4 5"]);
    let without_each = "check: { assert: { let: { one: '1' }, that: 'one == 2' } }, message: '{one}'";
    assert_eq!(messages(without_each), ["1"]);
}

#[test]
fn names_of_a_check_are_those_of_each_fault() {
    let keys = |group: bool| {
        format!(
            "check: {{ fault: {{ kinds: ['no-weights'], group: {group}, only: 'kind != null', let: {{ of_kind: \"kind + '!'\", all: \
             'count' }} }} }}, message: '{{of_kind}} {{all}}'"
        )
    };
    for group in [false, true] {
        let without_weights = r#"[{ remove: "model.safetensors" }]"#;
        assert_eq!(outcome(without_weights, &keys(group)).0, ["no-weights! 1"], "{group}");
    }
}

#[test]
fn a_condition_on_a_name_without_a_value_reports_nothing_and_states_why() {
    let failing = "message: '{kv}', let: { kv: 'config.kv', ratio: 'kv / 2' }";
    for check in [
        "check: { assert: { that: 'ratio > 1' } }",
        "check: { assert: { each: '[ratio]', that: 'false' } }",
        "check: { assert: { let: { half: 'ratio / 2' }, that: 'half > 1' } }",
    ] {
        let (messages, skipped, is_unusable) = outcome("[]", &format!("{check}, {failing}"));
        assert_eq!((messages.len(), is_unusable), (0, false), "{check}");
        assert_eq!(skipped, ["cannot be evaluated: No such key: kv"], "{check}");
    }
    let on_missing = "check: { assert: { that: 'beams > 1' } }, message: 'm', let: { beams: 'processor.num_beams' }";
    assert_eq!(outcome("[]", on_missing).1, ["processor_config.json is missing"]);
    let misspelt = "check: { assert: { that: 'heads > 1' } }, message: 'm', let: { heads: 'confg.heads' }";
    assert!(outcome("[]", misspelt).2);
}
