//! Row J7: chat templates that cost work, memory or depth.

use serde_json::{Value, json};

use super::{Case, bounded};

pub fn cases() -> Vec<Case> {
    let doubled = |n: usize, join: &str| {
        let lines = (0..n).map(|i| format!("{{% set a{} = a{i} {join} a{i} %}}", i + 1)).collect::<Vec<_>>().concat();
        format!("{lines}{{{{ a{n} | length }}}}{{{{ a{n} }}}}")
    };
    let loops = |depth: usize| {
        let open = (0..depth).map(|i| format!("{{% for x{i} in range(99999) %}}")).collect::<Vec<_>>().concat();
        format!("{open}{{{{ messages }}}}{}", "{% endfor %}".repeat(depth))
    };
    let long = "{% set a = 'x' * 60000 %}";
    let texts = [
        ("five nested loops", loops(5)),
        ("a thousand nested loops", loops(1_000)),
        ("a hundred thousand conditions", format!("{}{}", "{% if x %}".repeat(100_000), "{% endif %}".repeat(100_000))),
        ("thousands of brackets", format!("{{{{ {}1{} }}}}", "(".repeat(20_000), ")".repeat(20_000))),
        ("thousands of signs", format!("{{{{ {}1 }}}}", "-".repeat(50_000))),
        ("thousands of attributes", format!("{{{{ a{} }}}}", ".a".repeat(50_000))),
        ("thousands of conditions in one", format!("{{{{ {}1 }}}}", "a if b else ".repeat(20_000))),
        ("a thousand alternatives", format!("{{% if a %}}{}{{% endif %}}", "{% elif a %}".repeat(4_000))),
        ("thousands of sums", format!("{{{{ {}1 }}}}", "1+".repeat(25_000))),
        ("thousands of filters", format!("{{{{ a{} }}}}", "|e".repeat(25_000))),
        ("thousands of calls", format!("{{{{ a{} }}}}", "()".repeat(25_000))),
        ("thousands of literals", format!("{{{{ {} }}}}", "'a'".repeat(18_000))),
        ("a long list", format!("{{{{ [{}] }}}}", "1,".repeat(25_000))),
        ("a string doubled", format!("{{% set a0 = 'xxxxxxxx' %}}{}", doubled(60, "~"))),
        ("a list doubled", format!("{{% set a0 = [1] %}}{}", doubled(60, "+"))),
        (
            "a string doubled in a loop",
            "{% set n = namespace(a='x') %}{% for i in range(99) %}{% set n.a = n.a ~ n.a %}{% endfor %}{{ n.a }}"
                .to_owned(),
        ),
        ("a string times 10^18", "{{ 'xxxxxxxx' * 1000000000000000000 }}".to_owned()),
        ("a string times 10^7, often", "{% for i in range(9999) %}{{ 'x' * 9999999 }}{% endfor %}".to_owned()),
        ("a power of powers", "{{ 9 ** 9 ** 9 ** 9 }}".to_owned()),
        ("a replacement of every letter", format!("{long}{{{{ a.replace('x', a) }}}}{{{{ a | replace('x', a) }}}}")),
        ("a replacement of nothing", format!("{long}{{{{ a.replace('', a) }}}}")),
        ("a join of long parts", format!("{long}{{{{ a.join(range(9999)) }}}}{{{{ [a] * 99999 | join(a) }}}}")),
        (
            "a split of long text",
            format!("{long}{{% for i in range(999) %}}{{% set b = a.split('x') %}}{{% endfor %}}"),
        ),
        ("a format of great width", "{{ '%999999999d' | format(1) }}{{ '{:999999999}'.format(1) }}".to_owned()),
        ("great indents", "{{ 'a' | indent(999999999) }}{{ [[1]] | tojson(indent=999999999) }}".to_owned()),
        ("a macro that calls itself", "{% macro m() %}{{ m() }}{{ m() }}{% endmacro %}{{ m() }}".to_owned()),
        ("a loop that calls itself", "{% for m in messages recursive %}{{ loop(messages) }}{% endfor %}".to_owned()),
        (
            "a sort of a long range",
            "{% for i in range(9999) %}{{ range(99999) | sort | list | length }}{% endfor %}".to_owned(),
        ),
        ("megabytes of text", "x".repeat(3_000_000)),
        ("megabytes of tags", "{{ a }}".repeat(400_000)),
        ("unclosed tags", "{{ ".repeat(80_000)),
        ("unclosed comments", "{# ".repeat(80_000)),
        ("control characters", "\u{0}\u{1b}[2J{{ \u{202e} }}".to_owned()),
    ];
    let mut cases: Vec<Case> = texts
        .into_iter()
        .map(|(name, text)| {
            bounded("J7", format!("a template of {name}"), move |d| {
                d.llama();
                d.edit("tokenizer_config.json", "/chat_template", &json!(text));
            })
        })
        .collect();
    let named: Vec<Value> =
        (0..20_000).map(|i| json!({ "name": i.to_string(), "template": "{{ messages }}" })).collect();
    for (name, value) in [
        ("twenty thousand templates", json!(named)),
        ("templates of lists", json!([[], {}, { "template": [] }, { "name": "default", "template": 7 }, null])),
        ("a template of an object", json!({ "default": "{{" })),
    ] {
        cases.push(bounded("J7", name, move |d| {
            d.llama();
            d.edit("tokenizer_config.json", "/chat_template", &value);
        }));
    }
    cases.push(bounded("J7", "class names of megabytes", |d| {
        d.llama();
        d.edit("tokenizer_config.json", "/tokenizer_class", &json!("x".repeat(3_000_000)));
        d.put(
            "preprocessor_config.json",
            json!({ "image_processor_type": "y".repeat(3_000_000), "auto_map": 7 }).to_string(),
        );
    }));
    cases
}
