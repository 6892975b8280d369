//! Why a limit has no row.

use regex::Regex;

/// Limits, each as in [`super::Limit::at`], and why they have no row. `NOT TOLD` is a fault of the program: what is beyond such a
/// limit is not judged, and no finding says so. A path with a name in a reason is a limit or a test that holds in its place.
const REASONS: &[(&[&str], &str)] = &[
    (
        &[
            "src/check/adapter/config.rs CAP",
            "src/check/bounded.rs BYTES",
            "src/check/bounded.rs MESSAGE",
            "src/check/judge/integers.rs CAP",
            "src/check/judge/unscaled.rs CAP",
            "src/check/layers.rs CAP",
            "src/check/load/report.rs LISTED",
            "src/check/load/report.rs LISTED_BYTES",
            "src/check/model_type.rs CAP",
            "src/check/templates.rs CAP",
            "src/checkpoint/document/read/build.rs MAX_POINTER",
            "src/checkpoint/pickle/state_dict.rs KEYS",
        ],
        "Only what a report shows: a text is shortened, or the others of a list are counted.",
    ),
    (
        &["src/checkpoint/fault.rs NON_FINITE_CAP"],
        "Fewer findings are listed, and the others counted: src/check/evaluate.rs CAP.",
    ),
    (
        &["src/checkpoint/fault.rs COMPARISON_CAP"],
        "NOT TOLD: an effect that only a later fault of the same kind has, as beyond src/check/evaluate.rs CAP.",
    ),
    (
        &["src/checkpoint/document/read/duplicates.rs FOUND_CAP"],
        "Fewer are listed: src/checkpoint/fault.rs KIND_CAP. The number of the others is then too low.",
    ),
    (
        &["src/checkpoint/document/read/duplicates.rs REREAD_CAP"],
        "Only duplicate keys are read again, so one is told before any other is passed over.",
    ),
    (
        &["src/checkpoint/scan.rs SLIP_CAP"],
        "Any slip makes the same loads fail, and fewer are listed: src/checkpoint/fault.rs KIND_CAP.",
    ),
    (
        &["src/checkpoint/pointer.rs MAX_STEPS"],
        "No document that is read is nested more deeply: src/checkpoint/scan.rs MAX_DEPTH.",
    ),
    (
        &["src/check/built_tokenizer.rs MAX_DEPTH", "src/check/tokenizer_json.rs MAX_DEPTH"],
        "Each takes two levels of a document, which has no more: src/checkpoint/scan.rs MAX_DEPTH.",
    ),
    (
        &["src/checkpoint/module/parse.rs MAX_PROGRESS"],
        "The module counts as not read, as beyond src/checkpoint/module/parse.rs MAX_BYTES; the steps are those of the parser.",
    ),
    (
        &["src/checkpoint/pickle/machine.rs MAX_MEMO"],
        "A row would take ten seconds: tests/it/readers/pickles.rs bombs_of_the_stack_machine_are_refused.",
    ),
    (
        &["src/checkpoint/budget.rs TOTAL"],
        "A row would take a minute: tests/it/excess.rs every_excess_is_bounded_and_counted.",
    ),
    (
        &[
            "src/check/config_pattern.rs BACKTRACKS",
            "src/check/config_pattern.rs COMPILED",
            "src/check/config_pattern.rs LONGEST",
            "src/check/config_pattern.rs LONGEST_NAME",
            "src/check/config_pattern.rs STATES",
        ],
        "Whether the pattern of the config matches is unknown, and so is what depends on it.",
    ),
    (
        &["src/check/load/pattern.rs BACKTRACKS", "src/check/load/pattern.rs LONGEST"],
        "A longer name is neither renamed nor ignored, so it is an unexpected tensor.",
    ),
    (
        &["src/check/templates/render.rs FUEL", "src/check/templates/render.rs MUCH_FUEL"],
        "The steps of a template are those of the engine; src/check/templates/render.rs MAX_STRING ends in the same finding.",
    ),
    (&["src/check/compare.rs FILE_CAP"], "`diff` lists the file among what was not compared."),
    (&["src/check/tokens.rs MAX_ADDED"], "Nothing is predicted of the model."),
    (
        &[
            "src/checkpoint/contents/git_index.rs CAP",
            "src/checkpoint/contents/hashes.rs RECORD_CAP",
            "src/checkpoint/contents.rs HASHED_ZEROS",
        ],
        "The file counts as one that was not compared with a hash.",
    ),
    (
        &["src/checkpoint/contents/hashes.rs PLAIN_CAP"],
        "Larger files are read twice where their pointer has another hash.",
    ),
    (
        &["src/checkpoint/adapter/base.rs MAX_SHARDS"],
        "The other shards of the base model are unknown then; its class follows from its config.",
    ),
    (
        &["src/checkpoint/adapter/base.rs MAX_CONFIG", "src/checkpoint/adapter/base.rs MAX_COMMIT"],
        "The base model is unknown then, and the load of the adapter is not predicted.",
    ),
    (
        &[
            "src/check/load/stored.rs SEARCHED",
            "src/check/load/stored.rs SEARCHED_BYTES",
            "src/check/load/unwrapped.rs COMPARED",
            "src/check/compare/renamings.rs TRIED",
            "src/check/votes/space.rs COMPARED",
            "src/check/load/unwrapped.rs RENAMED",
            "src/check/load/unwrapped.rs TRIED",
            "src/check/size.rs BUDGET",
            "src/check/votes/space.rs BUDGET",
            "src/check/votes/space.rs EXPLAINING",
            "src/check/votes/space.rs LEAVES",
        ],
        "Only why tensors are missing or unexpected, or a size differs, is not searched further.",
    ),
    (
        &["src/checkpoint/card.rs CARD_CAP", "src/checkpoint/card.rs MAX_LINES"],
        "No loader reads a model card; the base model that it names is only quoted.",
    ),
    (
        &["src/checkpoint/git.rs CAP", "src/checkpoint/git.rs LINES"],
        "A `.gitattributes` of the checkpoint is not read, only those above it in a work tree that is trusted.",
    ),
    (
        &["src/checkpoint/glob.rs MAX_LENGTH", "src/checkpoint/glob.rs MAX_NESTING"],
        "Patterns are those of rules and users: tests/it/excess/bombs.rs files_of_a_user_are_refused_with_their_name.",
    ),
    (
        &["src/check/evaluate.rs STEPS"],
        "Rules of a user alone are limited, and the run fails with the name of the rule.",
    ),
    (
        &["src/checkpoint/discover.rs MAX_DEPTH", "src/checkpoint/nested.rs MAX_DEPTH"],
        "NOT TOLD: what is in deeper folders. How deep a search goes is documented in the source.",
    ),
    (
        &["src/checkpoint/work.rs BASE", "src/checkpoint/work.rs PER_BYTE"],
        "A measure of cost; what exceeds it ends a pickle: tests/it/readers/pickles.rs bombs_of_the_stack_machine_are_refused.",
    ),
    (
        &["src/check/evaluate.rs PLACES"],
        "Fewer places are listed; the effects of all are looked for: src/check/evaluate.rs JUDGED.",
    ),
    (
        &["src/check/index.rs COMPARED"],
        "Nothing is predicted: tests/it/excess/limits/verdicts.rs a_tensor_behind_a_thousand_equal_ones_does_not_load.",
    ),
    (&["src/check/statistics.rs MAX_SETS"], "NOT TOLD: further sets of statistics."),
    (
        &["src/check/variables.rs DOCUMENT_BYTES", "src/check/variables.rs NAMES_MATCHED"],
        "NOT TOLD: rules that ask for a document or for names again.",
    ),
    (&["src/checkpoint/contents.rs NUMBERS"], "NOT TOLD: statistics in a tensor of more than eight thousand numbers."),
    (&["src/checkpoint/nested.rs MAX_NAMES"], "NOT TOLD: further folders, and the documents in them."),
    (
        &["src/checkpoint/shard/read.rs STRETCHES"],
        "NOT TOLD: whether the end of a file with ten thousand holes was written.",
    ),
];

/// What the reasons are about.
pub(super) fn all() -> impl Iterator<Item = &'static str> {
    REASONS.iter().flat_map(|(at, _)| *at).copied()
}

/// The limits and tests that reasons name, each as a file and a name.
pub(super) fn cited() -> Vec<(&'static str, &'static str)> {
    let citation = Regex::new(r"((?:src|tests)/[\w/]+\.rs) (\w+)").unwrap();
    let texts = REASONS.iter().map(|(_, why)| *why);
    texts
        .flat_map(|why| citation.captures_iter(why).map(|found| found.extract().1.into()).collect::<Vec<_>>())
        .collect()
}
