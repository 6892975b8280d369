//! The keys of data files, read off the structs that deserialise them.

use std::fmt::Write as _;

/// Markdown tables of every struct and enum of a source file that a data file fills.
pub fn tables(source: &str) -> String {
    let mut out = String::new();
    let (mut docs, mut serde, mut read) = (Vec::new(), String::new(), false);
    let mut inside = false;
    let mut separator = '_';
    for line in source.lines() {
        let text = line.trim();
        if let Some(doc) = text.strip_prefix("///") {
            docs.push(doc.trim().to_owned());
        } else if text.starts_with("#[derive") {
            read = text.contains("Deserialize");
        } else if text.starts_with("#[") {
            serde.push_str(text);
        } else if let Some(name) = declared(line) {
            // What is only made on the way from a file is no part of its form.
            separator = if serde.contains("kebab-case") { '-' } else { '_' };
            inside = read && !docs.is_empty() && !serde.contains("try_from");
            if inside {
                let _ = write!(out, "\n**{name}.** {}\n\n| key | | what it says |\n|---|---|---|\n", cell(&docs));
            }
            (docs, serde, read) = (Vec::new(), String::new(), false);
        } else if line == "}" {
            inside = false;
        } else {
            if inside
                && !serde.contains("(skip)")
                && let Some(key) = key(text, &serde, separator)
            {
                let optional = if serde.contains("default") || text.contains(": Option<") { "optional" } else { "" };
                let _ = writeln!(out, "| `{key}` | {optional} | {} |", cell(&docs));
            }
            docs.clear();
            serde.clear();
        }
    }
    out
}

fn cell(docs: &[String]) -> String {
    docs.iter()
        .filter(|d| !d.is_empty())
        .map(String::as_str)
        .collect::<Vec<_>>()
        .join(" ")
        .replace('|', "\\|")
        .replace("[`", "`")
        .replace("`]", "`")
}

fn declared(line: &str) -> Option<&str> {
    let rest = line.strip_prefix("pub(crate) ").or_else(|| line.strip_prefix("pub ")).unwrap_or(line);
    let name = rest.strip_prefix("struct ").or_else(|| rest.strip_prefix("enum "))?;
    name.split(|c: char| !c.is_alphanumeric()).next()
}

/// The key of a field, or of a variant, as a file spells it.
fn key(text: &str, serde: &str, separator: char) -> Option<String> {
    if let Some((_, rest)) = serde.split_once("rename = \"") {
        return rest.split('"').next().map(str::to_owned);
    }
    let text = text.strip_prefix("pub ").unwrap_or(text);
    let word = text.split([':', '(', ',']).next()?;
    let plain = !word.is_empty() && word.chars().all(|c| c.is_alphanumeric() || c == '_');
    let mut key = String::new();
    for (i, c) in word.char_indices() {
        if c.is_uppercase() && i > 0 {
            key.push(separator);
        }
        key.extend(c.to_lowercase());
    }
    plain.then_some(key)
}
