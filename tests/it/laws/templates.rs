//! A chat template costs less than a second and 64 MiB, or is refused with a finding that names the file. Those outside the allow
//! list are rendered in a process under limits, and nothing is said of one that renders there.

use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;
use tempfile::TempDir;

use super::cases;
use crate::support::Draw;

/// Directories of one run of the program.
const BATCH: usize = 30;

/// Kibibytes of address space that a run may have: a run on directories without templates takes more than this less 64 MiB.
const SPACE: u64 = 192 << 10;

/// Ways to hold a value twice or once in a new one; `X` is the value.
const HOLDS: [&str; 12] = [
    "[X, X]",
    "[X, [X, 1]]",
    "{'x': X, 'y': X}",
    "{'x': [X], 'y': {'z': X}}",
    "X|chain(X)",
    "X | chain( X ) | list",
    "[X] + [X]",
    "dict(a=X, b=X)",
    "namespace(a=X, b=X)",
    "[X]",
    "[X,X,X] if true else X",
    "([X, X])",
];

/// Ways to walk over a value.
const USES: [&str; 14] = [
    "{{ X }}",
    "{{ X == X }}",
    "{{ X == Y }}",
    "{{ Y in X }}",
    "{{ X < Y }}",
    "{{ [X, Y]|sort }}",
    "{{ [X, Y]|unique }}",
    "{{ {X: 1} }}",
    "{{ X|tojson }}",
    "{{ 'a' ~ X }}",
    "{{ X|string|length }}",
    "{{ [X, Y]|min }}",
    "{{ X|join(',') }}",
    "{{ X|pprint }}",
];

/// Numbers that nothing in a text has.
const LARGE: [&str; 7] =
    ["999999", "99999999999", "10 ** 9", "1000 * 1000 * 1000", "2147483647", "'99999999'|int", "range(99999)|sum"];

/// Work by a number; `N` is the number.
const SIZED: [&str; 22] = [
    "{{ [1]|tojson(N) }}",
    "{{ [[[1]]]|tojson(indent=N) }}",
    "{{ messages|tojson(indent=N) }}",
    "{{ 'a'|indent(N) }}",
    "{{ 'a\\nb'|indent(width=N, first=true) }}",
    "{{ 'x' * (N) }}",
    "{{ [1] * (N) }}",
    "{{ ['x' * 999] * (N) }}",
    "{{ range(N)|list }}",
    "{{ range(0, N, 1)|sort|join }}",
    "{% for i in range(N) %}{{ messages }}{% endfor %}",
    "{{ messages|batch(N, 'x')|list }}",
    "{{ messages|slice(N)|list }}",
    "{{ 'x'.center(N) }}",
    "{{ 'x'.ljust(N) }}",
    "{{ 'x'.zfill(N) }}",
    "{{ 1.5|round(N) }}",
    "{{ '%*d'|format(N, 1) }}",
    "{{ ('%' ~ (N) ~ 'd')|format(1) }}",
    "{{ ('{:' ~ (N) ~ '}').format(1) }}",
    "{{ 'x'.join(range(N)) }}",
    "{{ 10 ** (N) }}",
];

/// Whether it may cost too much, and its text.
fn template(draw: &mut Draw) -> (bool, String) {
    match draw.below(6) {
        0 => {
            let indents = ["{{ [1]|tojson(N) }}", "{{ [1]|tojson(indent=N) }}", "{{ messages|tojson(N) }}"];
            (true, draw.one(&indents).replace('N', draw.one(&LARGE)))
        }
        1 => (false, draw.one(&SIZED).replace('N', draw.one(&LARGE))),
        2 => looped(draw),
        3 => {
            // Without a loop, one variable after another.
            let (holds, steps) = (draw.one(&HOLDS[..3]), 18 + draw.below(30));
            let step = |i: usize| format!("{{% set a{} = {} %}}", i + 1, holds.replace('X', &format!("a{i}")));
            let use_ = draw.one(&USES).replace('X', &format!("a{steps}")).replace('Y', "a1");
            (true, format!("{{% set a0 = [1] %}}{}{use_}", (0..steps).map(step).collect::<String>()))
        }
        4 => {
            let (holds, use_) = (draw.one(&HOLDS[..4]).replace('X', "a"), draw.one(&USES).replace(['X', 'Y'], "a"));
            let texts = [
                format!("{{% macro f(a) %}}{{{{ f({holds}) }}}}{use_}{{% endmacro %}}{{{{ f([1]) }}}}"),
                format!(
                    "{{% macro f(a, n) %}}{{% if n %}}{{{{ f({holds}, n - 1) }}}}{{% else %}}{use_}{{% endif %}}{{% endmacro %}}{{{{ f([1], 50) }}}}"
                ),
                format!("{{% for a in messages recursive %}}{{{{ loop([{holds}]) }}}}{use_}{{% endfor %}}"),
            ];
            (true, texts[draw.below(3)].clone())
        }
        _ => {
            let turns = [
                "{% for m in messages %}{{ '<|' + m.role + '|>' + m.content + '\\n' }}{% endfor %}",
                "{% set n = namespace(k=0) %}{% for m in messages %}{% set n.k = n.k + 1 %}{{ m.content }}{{ n.k }}{% endfor %}",
                "{% for m in messages %}{% set t = {'role': m.role, 'content': m.content} %}{{ t|tojson(indent=4) }}{% endfor %}",
                "{% set l = [] %}{% for m in messages %}{{ [m, m]|tojson }}{% endfor %}{{ l }}",
                "{% macro g(x) %}{{ x.content }}{% endmacro %}{% for m in messages %}{{ g(m) }}{% endfor %}",
            ];
            (false, draw.one(&turns).to_owned())
        }
    }
}

/// A namespace whose attribute holds itself in a loop.
fn looped(draw: &mut Draw) -> (bool, String) {
    let name = draw.one(&["n.a", "n['a']", "m.a"]);
    let steps = [
        format!("{{% set n.a = {} %}}", draw.one(&HOLDS).replace('X', name)),
        format!("{{% set b = {} %}}{{% set n.a = b %}}", draw.one(&HOLDS).replace('X', name)),
        format!("{{% set b = {name} %}}{{% set n.a = {} %}}", draw.one(&HOLDS).replace('X', "b")),
        format!("{{% for b in [{}] %}}{{% set n.a = b %}}{{% endfor %}}", draw.one(&HOLDS).replace('X', name)),
        format!("{{% with b = {} %}}{{% set n.a = b %}}{{% endwith %}}", draw.one(&HOLDS).replace('X', name)),
    ];
    let step = &steps[draw.below(5)];
    let times = draw.one(&["50", "99", "9999"]);
    let use_ = draw.one(&USES).replace('X', "n.a").replace('Y', "n.b");
    let text = format!(
        "{{% set n = namespace(a=[1], b=[1]) %}}{{% set m = n %}}{{% for i in range({times}) %}}{step}{{% endfor %}}{use_}"
    );
    (true, text)
}

/// Checks directories in one run within the limits; the report, or what ended the run.
fn check(room: &Path) -> Result<Value, String> {
    let script = format!("ulimit -c 0; ulimit -v {SPACE}; ulimit -t {BATCH}; exec \"$0\" \"$@\"");
    let output = Command::new("/bin/sh")
        .args(["-c", &script, env!("CARGO_BIN_EXE_ckpt-doctor"), "check", "--isolated", "--output-format", "json"])
        .arg(room)
        .env("XDG_STATE_HOME", crate::support::state())
        .output()
        .unwrap();
    serde_json::from_slice(&output.stdout)
        .map_err(|_| format!("{:?} {}", output.status, String::from_utf8_lossy(&output.stderr)))
}

#[test]
fn a_template_costs_little_or_is_refused() {
    let mut draw = Draw::new(31);
    let all: Vec<(bool, String)> = (0..cases(180)).map(|_| template(&mut draw)).collect();
    let (mut wrong, mut refused) = (Vec::new(), 0_usize);
    for batch in all.chunks(BATCH) {
        let room = TempDir::new().unwrap();
        for (number, (_, text)) in batch.iter().enumerate() {
            let dir = room.path().join(format!("{number:02}"));
            fs::create_dir(&dir).unwrap();
            fs::write(dir.join("tokenizer_config.json"), "{}").unwrap();
            fs::write(dir.join("tokenizer.json"), "{}").unwrap();
            fs::write(dir.join("config.json"), "{}").unwrap();
            fs::write(dir.join("chat_template.jinja"), text).unwrap();
        }
        let report = check(room.path()).unwrap_or_else(|why| {
            let alone = |number: &usize| check(&room.path().join(format!("{number:02}"))).is_err();
            let texts: Vec<&str> = (0..batch.len()).filter(alone).map(|number| batch[number].1.as_str()).collect();
            panic!("{why}\nends the program alone: {texts:#?}")
        });
        for checkpoint in report["checkpoints"].as_array().unwrap() {
            let number: usize = checkpoint["path"].as_str().unwrap().rsplit('/').next().unwrap().parse().unwrap();
            let (costly, text) = &batch[number];
            let findings = checkpoint["findings"].as_array().unwrap();
            let named =
                findings.iter().any(|f| f["code"] == "TOK025" && f["locations"][0]["file"] == "chat_template.jinja");
            let is_sound = !costly && text.contains("for m in messages");
            refused += usize::from(*costly && named);
            if is_sound && named {
                wrong.push(text.as_str());
            }
        }
    }
    assert!(wrong.is_empty(), "refused: {} of {}:\n{}", wrong.len(), all.len(), wrong.join("\n"));
    // A list that holds itself once renders in a process of its own, and so do some uses of the others.
    let costly = all.iter().filter(|(costly, _)| *costly).count();
    assert!(refused * 10 > costly * 7, "{refused} of {costly} are refused");
}
