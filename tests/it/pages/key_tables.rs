//! Markdown tables of the keys that a JSON Schema describes.

use std::fmt::Write as _;

use serde_json::{Map, Value};

use super::markdown;

/// One table for the root of a schema, and one for each of its definitions.
pub fn tables(schema: &Value) -> String {
    let tables = Tables(&schema["$defs"]);
    let mut out = tables.section("", schema);
    for (name, definition) in schema["$defs"].as_object().into_iter().flatten() {
        // Named strings are explained above the tables; a union is described by its variants.
        if definition["type"] != "string" && definition.get("anyOf").is_none() {
            out.push_str(&tables.section(name, definition));
        }
    }
    out
}

/// The definitions that a schema references.
struct Tables<'s>(&'s Value);

impl Tables<'_> {
    fn section(&self, name: &str, schema: &Value) -> String {
        let title = if name.is_empty() { String::new() } else { format!("**{}.** ", words(name)) };
        let mut out = format!("\n{title}{}\n", markdown(text(schema)));
        if let Some(forms) = schema["oneOf"].as_array() {
            let constants = forms.iter().all(|form| form.get("properties").is_none());
            out.push_str(if constants { "\n| value | meaning |\n|---|---|\n" } else { HEAD });
            for form in forms {
                match form["properties"].as_object() {
                    Some(properties) => self.variant(&mut out, properties, form),
                    None if constants => {
                        let _ = writeln!(out, "| {} | {} |", constant(form), cell(form));
                    }
                    None => {
                        let _ = writeln!(out, "| {} | | {} |", constant(form), cell(form));
                    }
                }
            }
        } else if let Some(properties) = schema["properties"].as_object().filter(|p| !p.is_empty()) {
            out.push_str(HEAD);
            self.keys(&mut out, "", properties, schema);
        }
        out
    }

    /// A variant with one key, whose value may be an object described in place.
    fn variant(&self, out: &mut String, properties: &Map<String, Value>, form: &Value) {
        for (key, value) in properties {
            let described = if text(value).is_empty() { form } else { value };
            let _ = writeln!(out, "| `{key}` | {} | {} |", self.kind(value), cell(described));
            if let Some(inner) = value["properties"].as_object() {
                self.keys(out, &format!("{key}."), inner, value);
            }
        }
    }

    fn keys(&self, out: &mut String, prefix: &str, properties: &Map<String, Value>, schema: &Value) {
        let required = |key: &str| schema["required"].as_array().is_some_and(|list| list.iter().any(|k| k == key));
        for (key, value) in properties {
            let mark = if required(key) { " *" } else { "" };
            let _ = writeln!(out, "| `{prefix}{key}`{mark} | {} | {} |", self.kind(value), cell(value));
        }
    }

    /// The type of a value in words: `list of template`.
    fn kind(&self, schema: &Value) -> String {
        if let Some(name) = schema["$ref"].as_str().and_then(|path| path.strip_prefix("#/$defs/")) {
            let choice = self.0.get(name).filter(|definition| definition.get("anyOf").is_some());
            return choice.map_or_else(|| words(name).to_lowercase(), |choice| self.kind(choice));
        }
        if let Some(forms) = schema["anyOf"].as_array().or_else(|| schema["oneOf"].as_array()) {
            let forms: Vec<String> =
                forms.iter().filter(|form| form["type"] != "null").map(|form| self.kind(form)).collect();
            return forms.join(" / ");
        }
        let types: Vec<&str> = match &schema["type"] {
            Value::String(one) => vec![one],
            Value::Array(many) => many.iter().filter_map(Value::as_str).filter(|t| *t != "null").collect(),
            _ => {
                return if schema.get("const").is_some() || schema.get("enum").is_some() {
                    constant(schema)
                } else {
                    "any".to_owned()
                };
            }
        };
        let named = types.into_iter().map(|one| match one {
            "array" => format!("list of {}", self.kind(&schema["items"])),
            "object" if schema["additionalProperties"].is_object() => {
                format!("map to {}", self.kind(&schema["additionalProperties"]))
            }
            other => other.to_owned(),
        });
        named.collect::<Vec<_>>().join(" / ")
    }
}

const HEAD: &str = "\n| key | value | meaning |\n|---|---|---|\n";

fn constant(form: &Value) -> String {
    let values = form["enum"].as_array().cloned().unwrap_or_else(|| vec![form["const"].clone()]);
    let values: Vec<String> = values.iter().filter_map(Value::as_str).map(|v| format!("`{v}`")).collect();
    values.join(", ")
}

/// `EditSpec` as `Edit spec`.
fn words(name: &str) -> String {
    let mut out = String::new();
    for (at, c) in name.char_indices() {
        if c.is_uppercase() && at > 0 {
            out.push(' ');
            out.extend(c.to_lowercase());
        } else {
            out.push(c);
        }
    }
    out
}

fn text(schema: &Value) -> &str {
    schema["description"].as_str().unwrap_or_default()
}

fn cell(schema: &Value) -> String {
    markdown(&text(schema).split_whitespace().collect::<Vec<_>>().join(" ")).replace('|', "\\|")
}
