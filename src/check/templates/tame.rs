//! Refuses templates whose cost the engine does not bound: it charges for strings, but builds sums of lists for free once
//! they are nested deeply, and its parser recurses over chains of operators.

/// Operators and names of operators in one tag; templates of published models have at most some 60.
const MAX_OPERATORS: usize = 250;

/// Sums outside loops that may be of lists. Each doubles a list at most, and the engine copies one that is nested 32 deep.
const MAX_SUMS: usize = 20;

/// Tags that continue a condition: the parser recurses over them.
const MAX_BRANCHES: usize = 300;

/// Words that are operators.
const WORDS: [&str; 7] = ["if", "else", "and", "or", "not", "in", "is"];

/// Whether a template may be given to the engine.
pub(super) fn is_tame(text: &str) -> bool {
    let mut rest = text;
    let (mut depth, mut in_macro, mut sums, mut branches) = (0_usize, 0_usize, 0_usize, 0_usize);
    while let Some(at) = rest.find('{') {
        let (_, opened) = rest.split_at(at);
        let Some(end) = close_of(opened) else {
            rest = opened.get(1..).unwrap_or_default();
            continue;
        };
        let (found, after) = opened.split_at(end);
        rest = after;
        if found.starts_with("{#") {
            continue;
        }
        let tag = Tag::of(found);
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
        let keeps = matches!(tag.word, "set" | "with") && depth > 0 || in_macro > 0;
        if tag.operators > MAX_OPERATORS
            || tag.word == "raw"
            || sums > MAX_SUMS
            || branches > MAX_BRANCHES
            || keeps && tag.sums > 0
        {
            return false;
        }
    }
    true
}

/// Where a tag that begins here ends; `None` for a brace that begins none, or one without an end, which does not parse.
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
    /// Its first word.
    word: &'t str,
    operators: usize,
    /// Additions without a literal beside them.
    sums: usize,
    is_recursive: bool,
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
        Self { word, operators: words.saturating_add(symbols), sums, is_recursive }
    }
}

#[cfg(test)]
mod tests {
    use super::is_tame;

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
}
