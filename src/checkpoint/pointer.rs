//! JSON pointers (RFC 6901): escaping, joining, setting and removing values. `Value::pointer` reads them.

use serde_json::{Map, Value};

use super::scan::MAX_DEPTH;

/// Escapes a step: `~` becomes `~0`, `/` becomes `~1`.
pub fn escape(step: &str) -> String {
    step.replace('~', "~0").replace('/', "~1")
}

/// Appends a step.
pub fn push(pointer: &mut String, step: &str) {
    pointer.push('/');
    pointer.push_str(&escape(step));
}

/// The pointer to the member `step` of the value at `parent`.
pub fn join(parent: &str, step: &str) -> String {
    format!("{parent}/{}", escape(step))
}

/// Maximum number of steps: a document that is nested more deeply is not read, so none leads to a value.
pub const MAX_STEPS: usize = MAX_DEPTH;

/// The steps, unescaped; `None` when the pointer is neither empty nor begins with `/`, or has more than [`MAX_STEPS`].
pub fn steps(pointer: &str) -> Option<Vec<String>> {
    if pointer.is_empty() {
        return Some(Vec::new());
    }
    if memchr::memchr_iter(b'/', pointer.as_bytes()).nth(MAX_STEPS).is_some() {
        return None;
    }
    Some(pointer.strip_prefix('/')?.split('/').map(unescape).collect())
}

fn unescape(step: &str) -> String {
    step.replace("~1", "/").replace("~0", "~")
}

/// Sets the value at a pointer; `None` when a step leads through a scalar.
///
/// A missing or null value on the way is copied from the same pointer of `defaults`, or else becomes an empty object.
pub fn put(root: &mut Value, defaults: &Value, pointer: &str, value: Value) -> Option<()> {
    let steps = steps(pointer)?;
    let Some((last, way)) = steps.split_last() else {
        *root = value;
        return Some(());
    };
    let (mut here, mut default) = (root, defaults);
    for step in way {
        default = member(default, step).unwrap_or(&Value::Null);
        here = match here {
            Value::Object(map) => map.entry(step.clone()).or_insert(Value::Null),
            Value::Array(items) => items.get_mut(step.parse::<usize>().ok()?)?,
            _ => return None,
        };
        if here.is_null() {
            *here = if default.is_null() { Value::Object(Map::new()) } else { default.clone() };
        }
    }
    match here {
        Value::Object(map) => drop(map.insert(last.clone(), value)),
        Value::Array(items) => *items.get_mut(last.parse::<usize>().ok()?)? = value,
        _ => return None,
    }
    Some(())
}

fn member<'v>(value: &'v Value, step: &str) -> Option<&'v Value> {
    match value {
        Value::Object(map) => map.get(step),
        Value::Array(items) => items.get(step.parse::<usize>().ok()?),
        _ => None,
    }
}

/// Removes the member of an object at a pointer, if it exists.
pub fn remove(root: &mut Value, pointer: &str) {
    if let Some((parent, step)) = pointer.rsplit_once('/')
        && let Some(map) = root.pointer_mut(parent).and_then(Value::as_object_mut)
    {
        map.shift_remove(&unescape(step));
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn steps_are_escaped_and_unescaped() {
        let pointer = join(&join("", "a/b"), "~1");
        assert_eq!(pointer, "/a~1b/~01");
        assert_eq!(steps(&pointer), Some(vec!["a/b".to_owned(), "~1".to_owned()]));
        assert_eq!((steps(""), steps("a")), (Some(Vec::new()), None));
        assert!(steps(&"/a".repeat(MAX_STEPS)).is_some());
        assert_eq!((steps(&"/a".repeat(MAX_STEPS + 1)), steps(&"/".repeat(1 << 24))), (None, None));
    }

    #[test]
    fn values_are_put_with_what_is_missing_around_them() {
        let defaults = json!({ "text_config": { "layers": 2 } });
        let mut root = json!({ "list": [1, { "a": 2 }], "text_config": null });
        for (pointer, value) in [("/list/1/a", 3), ("/text_config/width", 4), ("/a~1b/c", 5), ("/list/0", 6)] {
            assert_eq!(put(&mut root, &defaults, pointer, json!(value)), Some(()), "{pointer}");
        }
        let expected =
            json!({ "list": [6, { "a": 3 }], "text_config": { "layers": 2, "width": 4 }, "a/b": { "c": 5 } });
        assert_eq!(root, expected);
        for pointer in ["/list/7", "/list/x/a", "/list/0/a"] {
            assert_eq!(put(&mut root, &defaults, pointer, json!(0)), None, "{pointer}");
        }
        remove(&mut root, "/a~1b/c");
        remove(&mut root, "/list/0");
        assert_eq!(root, json!({ "list": [6, { "a": 3 }], "text_config": { "layers": 2, "width": 4 }, "a/b": {} }));
    }
}
