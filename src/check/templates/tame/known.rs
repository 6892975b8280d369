//! The allow list of templates that are rendered in this process: statements, filters, methods and functions whose work the
//! engine charges for, or bounds by the values that it is given. They are those that published templates use.

use std::collections::BTreeSet;

use super::{Tag, tags};

/// Words that open a tag, and their ends.
const STATEMENTS: [&str; 15] = [
    "if",
    "elif",
    "else",
    "endif",
    "for",
    "endfor",
    "set",
    "endset",
    "macro",
    "endmacro",
    "break",
    "continue",
    "generation",
    "endgeneration",
    "",
];

/// Filters. `map` is known with `attribute=` only: it may also name a filter, in a string.
const FILTERS: [&str; 36] = [
    "abs",
    "capitalize",
    "count",
    "d",
    "default",
    "dictsort",
    "e",
    "escape",
    "first",
    "float",
    "int",
    "items",
    "join",
    "last",
    "length",
    "list",
    "lower",
    "lstrip",
    "map",
    "max",
    "min",
    "reject",
    "rejectattr",
    "replace",
    "reverse",
    "rstrip",
    "safe",
    "select",
    "selectattr",
    "sort",
    "string",
    "strip",
    "title",
    "tojson",
    "trim",
    "upper",
];

/// Methods of Python's strings and dictionaries, and of loops.
const METHODS: [&str; 20] = [
    "append",
    "capitalize",
    "changed",
    "cycle",
    "endswith",
    "get",
    "items",
    "join",
    "keys",
    "lower",
    "lstrip",
    "replace",
    "rstrip",
    "split",
    "splitlines",
    "startswith",
    "strip",
    "title",
    "upper",
    "values",
];

/// Functions that transformers and the engine define.
const FUNCTIONS: [&str; 3] = ["namespace", "raise_exception", "strftime_now"];

/// Words that stand before a parenthesis and call nothing.
const KEYWORDS: [&str; 8] = ["if", "elif", "else", "and", "or", "not", "in", "is"];

/// The first name of a template that is not in the allow list, with the word for what it is; `None` if all are.
pub(in crate::check::templates) fn unknown_name(text: &str) -> Option<String> {
    let macros: BTreeSet<String> =
        tags(text).filter(|tag| tag.word == "macro").filter_map(|tag| name_of_macro(&tag)).collect();
    tags(text).find_map(|tag| of_tag(&tag, &macros))
}

/// The name that a `macro` tag defines.
fn name_of_macro(tag: &Tag<'_>) -> Option<String> {
    Some(tag.expression.split_once('(')?.0.trim().to_owned())
}

fn of_tag(tag: &Tag<'_>, macros: &BTreeSet<String>) -> Option<String> {
    if !STATEMENTS.contains(&tag.word) {
        return Some(format!("the statement {}", tag.word));
    }
    if tag.is_recursive {
        return Some("a recursive loop".to_owned());
    }
    let mut before = ["", ""];
    let mut rest = tag.expression.as_str();
    // The last character before the next name, without space.
    let mut left = ' ';
    loop {
        let is_word = |c: char| c.is_alphanumeric() || c == '_';
        let start = rest.find(is_word).unwrap_or(rest.len());
        let (gap, from) = rest.split_at(start);
        if is_called(left, gap) {
            return Some("a call of a value".to_owned());
        }
        left = gap.trim_end().chars().next_back().unwrap_or(if start == 0 { left } else { ' ' });
        let end = from.find(|c| !is_word(c)).unwrap_or(from.len());
        let (name, after) = from.split_at(end);
        if name.is_empty() {
            return None;
        }
        let unknown = Name { name, left, before, after: after.trim_start() }.unknown(macros);
        if unknown.is_some() {
            return unknown;
        }
        before = [before[1], name];
        (left, rest) = ('a', after);
    }
}

/// Whether a parenthesis or a string is called in the text between two names: `(a)(b)`, `a[0](b)`.
fn is_called(left: char, gap: &str) -> bool {
    let mut before = left;
    for c in gap.chars().filter(|c| !c.is_whitespace()) {
        if c == '(' && matches!(before, ')' | ']' | '}' | '\'' | '"') {
            return true;
        }
        before = c;
    }
    false
}

/// A name in an expression.
struct Name<'t> {
    name: &'t str,
    /// The character before it, without space.
    left: char,
    /// The two names before it.
    before: [&'t str; 2],
    /// The text behind it, without space at its start.
    after: &'t str,
}

impl Name<'_> {
    fn unknown(&self, macros: &BTreeSet<String>) -> Option<String> {
        let Self { name, left, before, after } = self;
        let is_call = after.starts_with('(');
        let is_test = before[1] == "is" || before == &["is", "not"];
        let (what, is_known) = match left {
            '|' => ("filter", FILTERS.contains(name) && (*name != "map" || maps_attribute(after))),
            '.' if is_call => ("method", METHODS.contains(name)),
            _ if is_call && !KEYWORDS.contains(name) && !is_test => {
                ("function", FUNCTIONS.contains(name) || macros.contains(*name))
            }
            _ => return None,
        };
        (!is_known).then(|| format!("the {what} {name}"))
    }
}

fn maps_attribute(after: &str) -> bool {
    after.strip_prefix('(').is_some_and(|inside| inside.trim_start().starts_with("attribute"))
}

#[cfg(test)]
mod tests {
    use super::unknown_name;

    #[test]
    fn names_outside_of_the_allow_list_are_found() {
        for (text, name) in [
            ("{{ 'a'|xmlattr }}", "the filter xmlattr"),
            ("{{ messages | map('tojson') | list }}", "the filter map"),
            ("{{ range(9) }}", "the function range"),
            ("{% for m in messages %}{{ m.content.zfill(9) }}{% endfor %}", "the method zfill"),
            ("{% for m in messages recursive %}{{ loop(m) }}{% endfor %}", "a recursive loop"),
            ("{% call f() %}{% endcall %}", "the statement call"),
            ("{% raw %}{% endraw %}", "the statement raw"),
            ("{% filter upper %}a{% endfilter %}", "the statement filter"),
            ("{{ (f)(1) }}", "a call of a value"),
            ("{{ messages[0](1) }}", "a call of a value"),
            ("{% set g = f %}{{ g(1) }}", "the function g"),
            ("{% if not f(1) %}{% endif %}", "the function f"),
        ] {
            assert_eq!(unknown_name(text).as_deref(), Some(name), "{text}");
        }
    }

    /// What published templates consist of, in one.
    #[test]
    fn names_of_published_templates_are_known() {
        for text in [
            "{%- if messages[0]['role'] == 'system' %}{%- set first = messages[0]['content'] | trim %}{%- endif %}",
            "{% macro f(a) %}{{- a.b | tojson(indent=4) }}{% endmacro %}{{ f(messages) }}{{ f (messages) }}",
            "{% if x is not defined or (x is string) and not (x == 'range(9)') %}{{ raise_exception('No (x)') }}{% endif %}",
            "{{ m.content.split('</think>')[-1].lstrip('\\n') + (m.content | length | string) }}",
            "{% set ns = namespace(found=false) %}{{ messages | selectattr('role', 'equalto', 'x') | map(attribute='y') | list }}",
            "{% if x is divisibleby(2) and x is not sameas(y) %}{% elif (a) in (b) %}{% endif %}",
            "{{ strftime_now('%d %b %Y') }}{% for k, v in tool.items() %}{{ loop.index0 }}{{ k ~ v|upper }}{% endfor %}",
            "{# {{ range(9) }} #}{% generation %}{{ m['content'] }}{% endgeneration %}",
        ] {
            assert_eq!(unknown_name(text), None, "{text}");
        }
    }
}
