//! Finds templates whose cost the engine does not bound: it charges for strings, but builds sums of lists for free once
//! they are nested deeply, and its parser recurses over chains of operators. [`unknown_name`] is the allow list beside this.

mod known;
mod nesting;

pub(super) use known::unknown_name;

use nesting::Nesting;

/// Operators and names of operators in one tag; templates of published models have at most some 60.
const MAX_OPERATORS: usize = 250;

/// Sums outside loops that may be of lists. Each doubles a list at most, and the engine copies one that is nested 32 deep.
const MAX_SUMS: usize = 20;

/// Tags that continue a condition: the parser recurses over them.
const MAX_BRANCHES: usize = 300;

/// Why a template is not rendered in this process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cost {
    /// One tag has too many operators.
    Operators,
    /// A raw block, whose text looks like tags.
    Raw,
    /// Sums that may double a list.
    Sums,
    /// Products that may repeat a list too often.
    Products,
    /// A condition has too many branches.
    Branches,
    /// A list or dictionary holds itself again and again, or one value too often.
    Nesting,
}

impl Cost {
    /// The words of a finding.
    pub(super) const fn reason(self) -> &'static str {
        match self {
            Self::Operators => "a tag has more than 250 operators",
            Self::Raw => "it has a raw block",
            Self::Sums => "sums may double a list again and again",
            Self::Products => "products may repeat a list more than 100000 times",
            Self::Branches => "a condition has more than 300 branches",
            Self::Nesting => "lists or dictionaries are nested in themselves again and again",
        }
    }
}

/// Times that the products of a template may repeat a list: one that is printed is not charged for before it exists.
const MAX_REPEATED: u64 = 100_000;

/// Words that are operators.
const WORDS: [&str; 7] = ["if", "else", "and", "or", "not", "in", "is"];

/// Why a template may not be given to the engine in this process; `None` if nothing speaks against it.
pub(super) fn cost(text: &str) -> Option<Cost> {
    let mut nesting = Nesting::default();
    let mut repeated = 1_u64;
    let (mut depth, mut in_macro, mut sums, mut branches) = (0_usize, 0_usize, 0_usize, 0_usize);
    for tag in tags(text) {
        nesting.add(tag.word, &tag.expression, depth > 0 || in_macro > 0);
        match tag.word {
            // Its body is called with other lists.
            "for" if tag.is_recursive => in_macro = in_macro.saturating_add(1),
            "for" => depth = depth.saturating_add(1),
            "endfor" => depth = depth.saturating_sub(1),
            "macro" | "call" => in_macro = in_macro.saturating_add(1),
            "endmacro" | "endcall" => in_macro = in_macro.saturating_sub(1),
            "elif" => branches = branches.saturating_add(1),
            _ => {}
        }
        sums = sums.saturating_add(tag.sums);
        repeated = repeated.saturating_mul(tag.repeated);
        let keeps = matches!(tag.word, "set" | "with") && depth > 0 || in_macro > 0;
        let over = [
            (tag.operators > MAX_OPERATORS, Cost::Operators),
            (tag.word == "raw", Cost::Raw),
            (sums > MAX_SUMS || keeps && tag.sums > 0, Cost::Sums),
            (repeated > MAX_REPEATED || keeps && tag.repeated > 1, Cost::Products),
            (branches > MAX_BRANCHES, Cost::Branches),
        ];
        if let Some((_, cost)) = over.into_iter().find(|(is_over, _)| *is_over) {
            return Some(cost);
        }
    }
    nesting.is_excessive().then_some(Cost::Nesting)
}

/// The tags of a template, without its comments.
fn tags(text: &str) -> impl Iterator<Item = Tag<'_>> {
    let mut rest = text;
    std::iter::from_fn(move || {
        loop {
            let (_, opened) = rest.split_at(rest.find('{')?);
            if !["{{", "{%", "{#"].iter().any(|open| opened.starts_with(open)) {
                rest = opened.get(1..).unwrap_or_default();
                continue;
            }
            // Without an end nothing parses, and nothing is run.
            let (found, after) = opened.split_at(close_of(opened)?);
            rest = after;
            if !found.starts_with("{#") {
                return Some(Tag::of(found));
            }
        }
    })
}

/// Where a tag that begins here ends; `None` for one without an end.
fn close_of(text: &str) -> Option<usize> {
    let close = match text.as_bytes().get(1)? {
        b'{' => "}}",
        b'%' => "%}",
        b'#' => return text.find("#}").map(|at| at.saturating_add(2)),
        _ => return None,
    };
    let mut quotes = Quotes::default();
    for (at, c) in text.char_indices().skip(2) {
        if !quotes.holds(c) && text.get(at..).is_some_and(|rest| rest.starts_with(close)) {
            return Some(at.saturating_add(2));
        }
    }
    None
}

/// Tells characters in string literals from others.
#[derive(Default)]
struct Quotes {
    open: Option<char>,
    escaped: bool,
}

impl Quotes {
    /// Whether this character, the next of the text, belongs to a literal.
    fn holds(&mut self, c: char) -> bool {
        match self.open {
            Some(_) if self.escaped => self.escaped = false,
            Some(_) if c == '\\' => self.escaped = true,
            Some(open) if c == open => self.open = None,
            Some(_) => {}
            None if matches!(c, '\'' | '"') => self.open = Some(c),
            None => return false,
        }
        true
    }
}

/// Figures of one tag.
struct Tag<'t> {
    /// The first word of a statement; empty for an expression.
    word: &'t str,
    operators: usize,
    /// Additions without a literal beside them.
    sums: usize,
    is_recursive: bool,
    /// The product of the numbers that multiply something; the largest number for a factor that is not a number.
    repeated: u64,
    /// The text behind the word, without the content of string literals.
    expression: String,
}

impl<'t> Tag<'t> {
    fn of(text: &'t str) -> Self {
        let is_word = |c: char| c.is_alphanumeric() || c == '_';
        let inside = text.strip_prefix("{%").unwrap_or_default();
        let word = inside.trim_start_matches(|c: char| matches!(c, '-' | '+') || c.is_whitespace());
        let word = word.split(|c| !is_word(c)).next().unwrap_or_default();
        let mut quotes = Quotes::default();
        // The text without literals, of which quotes are left.
        let plain: String = text.chars().filter(|c| !quotes.holds(*c) || matches!(c, '\'' | '"')).collect();
        let words = plain.split(|c| !is_word(c)).filter(|w| WORDS.contains(w)).count();
        let symbols = plain.chars().filter(|c| !is_word(*c) && !c.is_whitespace()).count();
        // A number, or the end of a string.
        let is_literal = |word: &str, end: Option<char>| {
            matches!(end, Some('\'' | '"')) || !word.is_empty() && word.chars().all(|c| c.is_ascii_digit())
        };
        let is_sum = |(at, _): &(usize, &str)| {
            let before = plain.get(..*at).unwrap_or_default().trim_end();
            let after = plain.get(at.saturating_add(1)..).unwrap_or_default().trim_start();
            let left = before.rsplit(|c| !is_word(c)).next().unwrap_or_default();
            let right = after.split(|c| !is_word(c)).next().unwrap_or_default();
            !is_literal(left, before.chars().next_back()) && !is_literal(right, after.chars().next())
        };
        // The signs beside the delimiters control whitespace.
        let sums = plain.match_indices('+').filter(is_sum).count();
        let is_recursive = word == "for" && plain.split(|c| !is_word(c)).any(|word| word == "recursive");
        let expression = plain.get(2..plain.len().saturating_sub(2)).unwrap_or_default();
        let expression = expression.trim_matches(|c: char| matches!(c, '-' | '+') || c.is_whitespace());
        let expression = expression.strip_prefix(word).unwrap_or(expression).to_owned();
        let repeated = repeated(&plain);
        Self { word, operators: words.saturating_add(symbols), sums, is_recursive, repeated, expression }
    }
}

/// The product of the numbers beside `*` in a tag without literals: of the smaller one of each pair, if both are numbers.
fn repeated(plain: &str) -> u64 {
    if !plain.contains('*') {
        return 1;
    }
    // `2 * 10 ** 9`.
    if plain.contains("**") {
        return if plain.replace("**", "").contains('*') { u64::MAX } else { 1 };
    }
    let is_digit = |c: char| c.is_ascii_digit();
    let number = |text: &str| text.parse::<u64>().ok();
    let factor = |(at, _): (usize, &str)| {
        let before = plain.get(..at).unwrap_or_default().trim_end();
        let after = plain.get(at.saturating_add(1)..).unwrap_or_default().trim_start();
        let left = number(before.get(before.trim_end_matches(is_digit).len()..).unwrap_or_default());
        let right = number(
            after.get(..after.len().saturating_sub(after.trim_start_matches(is_digit).len())).unwrap_or_default(),
        );
        match (left, right) {
            (Some(_), Some(_)) => 1,
            (left, right) => left.or(right).unwrap_or(u64::MAX),
        }
    };
    plain.match_indices('*').map(factor).fold(1, u64::saturating_mul)
}

#[cfg(test)]
mod tests {
    use super::{Cost, cost};

    fn is_tame(text: &str) -> bool {
        cost(text).is_none()
    }

    #[test]
    fn templates_that_cost_too_much_are_refused() {
        for (text, tame) in [
            ("{% for m in messages %}{{ '<|' + m.role + '|>' + m.content + eos_token }}{% endfor %}", true),
            ("{% set n = namespace(a=[]) %}{% for m in messages %}{% set n.a = n.a + n.a %}{% endfor %}", false),
            ("{% for m in messages %}{% set i = i + 1 %}{% endfor %}", true),
            ("{% for m in messages %}{% set a1 = a1 + a1 %}{% endfor %}", false),
            ("{% macro f(a) %}{{ f(a + a) }}{% endmacro %}", false),
            ("{% for m in messages recursive %}{{ loop(m + m) }}{% endfor %}", false),
            ("{# {% endfor %} #}{{ '{% raw %}' }}", true),
            ("{% raw %}{% endfor %}{% endraw %}", false),
        ] {
            assert_eq!(is_tame(text), tame, "{text}");
        }
        for (part, n) in [("{% set a = b + c %}", 21), ("{% elif x %}", 301)] {
            assert!(is_tame(&part.repeat(n - 1)) && !is_tame(&part.repeat(n)), "{part}");
        }
        assert!(!is_tame(&format!("{{{{ {}1 }}}}", "a if b else ".repeat(200))));
        assert!(is_tame(&"{{ 'a' ~ b }}".repeat(4_000)));
    }

    #[test]
    fn products_that_repeat_a_list_too_often_are_refused() {
        for (text, is_refused) in [
            ("{{ [1] * 999999 }}", true),
            ("{{ [1] * ('99999999'|int) }}", true),
            ("{{ [1] * 10 ** 9 }}", true),
            ("{% set a = [1] * 9999 %}{% set b = a * 9999 %}{{ b }}", true),
            ("{% for m in messages %}{% set n.a = n.a * 2 %}{% endfor %}", true),
            ("{{ '=' * 80 }}{{ loop.index0 * 2 }}{{ 10 ** 3 }}{{ 100000 * 100000 }}", false),
        ] {
            assert_eq!(cost(text) == Some(Cost::Products), is_refused, "{text}");
        }
    }

    #[test]
    fn values_that_hold_themselves_again_and_again_are_refused() {
        let looped = |tag: &str| format!("{{% for i in range(50) %}}{tag}{{% endfor %}}");
        for tag in [
            "{% set n.a = [n.a, n.a] %}",
            "{% set n.a = {'x': n.a, 'y': n.a} %}",
            "{% set n.a = n.a|chain(n.a) %}",
            "{% set n.a = [n.a] %}",
            "{% set n.a = [n['a'], 1] %}",
            "{% set b = [n.a] %}{% set n.a = [b] %}",
            "{% for b in [[n.a, n.a]] %}{% set n.a = b %}{% endfor %}",
            "{% with b = [n.a, n.a] %}{% set n.a = b %}{% endwith %}",
        ] {
            assert_eq!(cost(&format!("{{% set n = namespace(a=[1]) %}}{}", looped(tag))), Some(Cost::Nesting), "{tag}");
        }
        let alias = "{% set n = namespace(a=[1]) %}{% set m = n %}";
        assert_eq!(cost(&format!("{alias}{}", looped("{% set m.a = [n.a, n.a] %}"))), Some(Cost::Nesting));
        assert_eq!(cost("{% macro f(a) %}{{ f([a, a]) }}{% endmacro %}{{ f(1) }}"), Some(Cost::Nesting));
        assert_eq!(cost("{% for a in messages recursive %}{{ loop([a, a]) }}{% endfor %}"), Some(Cost::Nesting));
        assert_eq!(cost(&"{% set a = [a, a] %}".repeat(17)), Some(Cost::Nesting));
        let chain: Vec<String> = (0..20).map(|i| format!("{{% set a{} = [a{i}, a{i}] %}}", i + 1)).collect();
        let chain = chain.concat();
        assert_eq!(cost(&chain), Some(Cost::Nesting));
        for text in [
            "{% for m in messages %}{% set role = m.role %}{% set x = {'role': role, 'content': m.content} %}{% endfor %}",
            "{% set n = namespace(found=false) %}{% for m in messages %}{% set n.found = (n.found or m.role == 'x') %}{% endfor %}",
            "{% macro f(a) %}{{ f(a.items) }}{{ {'x': a.x, 'y': a.y}|tojson }}{% endmacro %}",
            "{% set a = [messages, messages] %}{% set b = [a, a] %}{{ b }}",
            "{% set n = namespace(last=none) %}{% for m in messages[::-1] %}{% set n.last = messages[n.last] %}{% endfor %}",
        ] {
            assert_eq!(cost(text), None, "{text}");
        }
    }
}
