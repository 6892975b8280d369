//! Collapses runs of numbered names: 26 `layers.N.mlp.up_proj.weight` become one line.

use std::collections::BTreeMap;

/// A pattern with the number of names that it matches.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NameGroup {
    /// A name, with `{0..25}` or `{0,3,5}` in place of numbers.
    pub pattern: String,
    /// Number of names that it matches.
    pub count: usize,
}

/// Numbers at one position of a name, sorted.
type NumberList = Vec<u64>;
/// The text between the numbers of a name.
type Words = Vec<String>;

/// Collapses names into patterns, in order of first occurrence.
///
/// A pattern matches exactly the given names: numbers are only combined if every combination occurs. A duplicate name
/// is counted twice only if it contains no numbers.
pub fn collapse<'a>(names: impl IntoIterator<Item = &'a str>) -> Vec<NameGroup> {
    collapse_with(names.into_iter().map(|name| (name, ())), |(), ()| ()).into_iter().map(|(group, ())| group).collect()
}

/// As [`collapse`], of names with a value each; that of a pattern is made of the values of its names by `join`.
pub fn collapse_with<'a, T: Copy>(
    named: impl IntoIterator<Item = (&'a str, T)>,
    join: impl Fn(T, T) -> T,
) -> Vec<(NameGroup, T)> {
    let mut order: Vec<Words> = Vec::new();
    let mut families: BTreeMap<Words, Vec<(NumberList, T)>> = BTreeMap::new();
    for (name, value) in named {
        let (words, numbers) = split(name);
        let family = families.entry(words).or_insert_with_key(|words| {
            order.push(words.clone());
            Vec::new()
        });
        family.push((numbers, value));
    }
    let mut groups = Vec::new();
    for words in order {
        let family = families.remove(&words).unwrap_or_default();
        let values = |wanted: &dyn Fn(&NumberList) -> bool| {
            family.iter().filter(|(numbers, _)| wanted(numbers)).map(|(_, value)| *value).reduce(&join)
        };
        if words.len() <= 1 {
            let group = NameGroup { pattern: words.concat(), count: family.len() };
            groups.extend(values(&|_| true).map(|value| (group, value)));
            continue;
        }
        let mut members: Vec<Vec<NumberList>> =
            family.iter().map(|(numbers, _)| numbers.iter().map(|n| vec![*n]).collect()).collect();
        for at in (0..words.len().saturating_sub(1)).rev() {
            members = gather(members, at);
        }
        for lists in members {
            let count = lists.iter().map(Vec::len).fold(1, usize::saturating_mul);
            let has = |numbers: &NumberList| numbers.iter().zip(&lists).all(|(n, list)| list.binary_search(n).is_ok());
            let group = NameGroup { pattern: pattern(&words, &lists), count };
            groups.extend(values(&has).map(|value| (group, value)));
        }
    }
    groups
}

/// Merges members that differ only in the numbers at position `at`.
fn gather(members: Vec<Vec<NumberList>>, at: usize) -> Vec<Vec<NumberList>> {
    let mut alike: BTreeMap<Vec<NumberList>, NumberList> = BTreeMap::new();
    for mut member in members {
        let here = member.get_mut(at).map(std::mem::take).unwrap_or_default();
        alike.entry(member).or_default().extend(here);
    }
    alike
        .into_iter()
        .map(|(mut member, mut here)| {
            here.sort_unstable();
            here.dedup();
            if let Some(slot) = member.get_mut(at) {
                *slot = here;
            }
            member
        })
        .collect()
}

/// Splits a name at the dotted components that are numbers: n numbers, n + 1 words.
fn split(name: &str) -> (Words, Vec<u64>) {
    let mut words = vec![String::new()];
    let mut numbers = Vec::new();
    for (i, part) in name.split('.').enumerate() {
        let dot = if i == 0 { "" } else { "." };
        // `007` and numbers beyond u64 would be printed differently, so they stay text.
        let number = part.parse::<u64>().ok().filter(|n| n.to_string() == part);
        if let Some(word) = words.last_mut() {
            word.push_str(dot);
            if number.is_none() {
                word.push_str(part);
            }
        }
        if let Some(n) = number {
            numbers.push(n);
            words.push(String::new());
        }
    }
    (words, numbers)
}

fn pattern(words: &[String], numbers: &[NumberList]) -> String {
    let mut out = String::new();
    for (i, word) in words.iter().enumerate() {
        out.push_str(word);
        match numbers.get(i).map(Vec::as_slice) {
            None => {}
            Some([one]) => out.push_str(&one.to_string()),
            Some(many) => {
                out.push('{');
                out.push_str(&ranges(many));
                out.push('}');
            }
        }
    }
    out
}

/// `0..3,5`: both ends are inclusive.
fn ranges(numbers: &[u64]) -> String {
    const PIECES: usize = 8;
    let mut runs: Vec<(u64, u64)> = Vec::new();
    for &n in numbers {
        match runs.last_mut() {
            Some((_, last)) if last.checked_add(1) == Some(n) => *last = n,
            _ => runs.push((n, n)),
        }
    }
    let mut pieces: Vec<String> = runs
        .iter()
        .take(PIECES)
        .map(|(first, last)| if first == last { first.to_string() } else { format!("{first}..{last}") })
        .collect();
    if runs.len() > PIECES {
        pieces.push("…".to_owned());
    }
    pieces.join(",")
}

#[cfg(test)]
mod tests {
    use super::{NameGroup, collapse};

    fn shown(names: &[&str]) -> Vec<(String, usize)> {
        collapse(names.iter().copied()).into_iter().map(|NameGroup { pattern, count }| (pattern, count)).collect()
    }

    #[test]
    fn the_value_of_a_pattern_is_that_of_its_names() {
        let named = [("l.0.w", 1), ("l.1.w", 2), ("l.1.b", 4), ("x", 8), ("l.3.w", 16)];
        let found = super::collapse_with(named, |a, b| a + b);
        let found: Vec<(&str, usize, i32)> = found.iter().map(|(g, sum)| (g.pattern.as_str(), g.count, *sum)).collect();
        assert_eq!(found, [("l.{0..1,3}.w", 3, 19), ("l.1.b", 1, 4), ("x", 1, 8)]);
    }

    #[test]
    fn full_products_become_one_pattern() {
        assert_eq!(
            shown(&["l.0.e.0.w", "l.0.e.1.w", "l.1.e.0.w", "l.1.e.1.w"]),
            [("l.{0..1}.e.{0..1}.w".to_owned(), 4)]
        );
    }

    #[test]
    fn partial_products_stand_for_nothing_else() {
        let shown = shown(&["l.0.e.0.w", "l.0.e.1.w", "l.1.e.0.w"]);
        assert_eq!(shown, [("l.1.e.0.w".to_owned(), 1), ("l.0.e.{0..1}.w".to_owned(), 2)]);
    }

    #[test]
    fn gaps_and_odd_spellings_are_kept() {
        assert_eq!(
            shown(&["a.3.w", "a.0.w", "a.1.w", "lone", "b.007", "b.99999999999999999999999"]),
            [
                ("a.{0..1,3}.w".to_owned(), 3),
                ("lone".to_owned(), 1),
                ("b.007".to_owned(), 1),
                ("b.99999999999999999999999".to_owned(), 1),
            ]
        );
    }

    #[test]
    fn every_name_is_counted_once() {
        let names: Vec<String> = (0..7).flat_map(|i| (0..i).map(move |j| format!("x.{i}.y.{j}"))).collect();
        let total: usize = collapse(names.iter().map(String::as_str)).iter().map(|g| g.count).sum();
        assert_eq!(total, names.len());
    }
}
