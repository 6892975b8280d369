//! Limits on chat templates.

use super::{Limit, repeated};

const FILE: &str = "chat_template.jinja";

pub(super) const LIMITS: &[Limit] = &[
    Limit {
        of: "bytes of a template",
        at: "src/check/templates/render.rs MAX_TEXT",
        most: 60_000,
        file: FILE,
        write: |n, _| repeated("x", n),
        says: "it has 60001 bytes, more than 60000",
    },
    Limit {
        of: "operators of a tag",
        at: "src/check/templates/tame.rs MAX_OPERATORS",
        most: 250,
        file: FILE,
        // The braces of a tag are four.
        write: |n, _| format!("{{{{ x{} }}}}", "-x".repeat(n - 4)).into_bytes(),
        says: "more than 250 operators",
    },
    Limit {
        of: "sums of a template",
        at: "src/check/templates/tame.rs MAX_SUMS",
        most: 20,
        file: FILE,
        write: |n, _| repeated("{{ a + b }}", n),
        says: "sums may double a list",
    },
    Limit {
        of: "branches of a template",
        at: "src/check/templates/tame.rs MAX_BRANCHES",
        most: 300,
        file: FILE,
        write: |n, _| format!("{{% if a %}}{}{{% endif %}}", "{% elif b %}".repeat(n)).into_bytes(),
        says: "more than 300 branches",
    },
    Limit {
        of: "times that a list is repeated",
        at: "src/check/templates/tame.rs MAX_REPEATED",
        most: 100_000,
        file: FILE,
        write: |n, _| format!("{{{{ [1] * {n} }}}}").into_bytes(),
        says: "products may repeat a list",
    },
    Limit {
        of: "indent of tojson",
        at: "src/check/templates/render.rs MAX_INDENT",
        most: 8,
        file: FILE,
        write: |n, _| format!("{{{{ [1]|tojson({n}) }}}}").into_bytes(),
        says: "tojson indents by 9 spaces",
    },
    Limit {
        of: "nesting of a template",
        at: "src/check/templates/tame/nesting.rs MAX_NESTED",
        most: 16,
        file: FILE,
        write: |n, _| repeated("{% set a = [a] %}", n),
        says: "nested in themselves",
    },
    Limit {
        of: "values of a variable of a template",
        at: "src/check/templates/tame/nesting.rs MAX_VALUES",
        most: 50_000,
        file: FILE,
        write: |n, _| values(n),
        says: "nested in themselves",
    },
    Limit {
        of: "bytes that a template writes",
        at: "src/check/templates/render.rs MAX_RENDERED",
        most: 256 << 10,
        file: FILE,
        write: |n, _| {
            let (times, rest) = (n / 1024, n % 1024);
            let part = "x".repeat(1024);
            // Lists of sixteen items, as a tag has few operators.
            let list = |n| vec!["1"; n].join(",");
            let inner = format!("{{% for i in [{}] %}}{part}{{% endfor %}}", list(16));
            let last = format!("{{% for i in [{}] %}}{part}{{% endfor %}}", list(times % 16));
            format!("{{% for i in [{}] %}}{inner}{{% endfor %}}{last}{}", list(times / 16), "x".repeat(rest))
                .into_bytes()
        },
        says: "it writes 262145 bytes",
    },
    Limit {
        of: "bytes of a string with a method",
        at: "src/check/templates/render.rs MAX_STRING",
        most: 64 << 10,
        file: FILE,
        write: |n, _| {
            format!("{{% set a %}}{}{{% endset %}}{{{{ (a ~ a)[:{n}].strip()|length }}}}", "x".repeat(40_000))
                .into_bytes()
        },
        says: "more than 60000 steps",
    },
    Limit {
        of: "depth of calls of a template",
        at: "src/check/templates/render.rs MAX_DEPTH",
        most: 60,
        file: FILE,
        write: |n, _| {
            // The template itself is one.
            format!("{}{}", "{% for a in [1] %}".repeat(n - 1), "{% endfor %}".repeat(n - 1)).into_bytes()
        },
        says: "nested more than 60 deep",
    },
    Limit {
        of: "nesting of a template that is parsed",
        at: "src/check/templates/render.rs of_error",
        most: 149,
        file: FILE,
        write: |n, _| format!("{}{}", "{% if a %}".repeat(n), "{% endif %}".repeat(n)).into_bytes(),
        says: "it is nested more deeply than is parsed",
    },
    Limit {
        of: "templates of a checkpoint",
        at: "src/check/templates.rs MAX_TEMPLATES",
        most: 16,
        file: "tokenizer_config.json",
        write: |n, _| {
            let ok = r#"{"name": "t#", "template": "x"}, "#;
            let list = super::numbered(ok, "", n - 1);
            format!("{{\"chat_template\": [{list}{{\"name\": \"default\", \"template\": \"{{% if %}}\"}}]}}")
                .into_bytes()
        },
        says: "the files have more than 16",
    },
];

/// A template with a variable of so many values.
fn values(n: usize) -> Vec<u8> {
    // A list has two values more than it holds, and a variable that is not assigned is one.
    let list = |name: &str, held: &[&str]| format!("{{% set {name} = [{}] %}}", held.join(","));
    let of = |held: &'static str, n: usize| vec![held; n];
    let (small, large) = (200, 24_002);
    let (times, rest) = ((n - 2) / large, (n - 2) % large);
    let last = [of("b", times), of("a", rest / small), of("x", rest % small)].concat();
    [list("a", &of("x", 198)), list("b", &of("a", 120)), list("c", &last)].concat().into_bytes()
}
