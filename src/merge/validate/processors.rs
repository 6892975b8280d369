//! Validates processors of users: the architectures that they name, and the variables of their expressions.

use std::collections::BTreeSet;

use crate::knowledge::processor::Processor;
use crate::knowledge::source::{DataError, hint};
use crate::knowledge::{Expression, Knowledge};

/// Validates a processor that was parsed from `text`, the content of the file `path`.
///
/// # Errors
/// [`DataError`] with the file, the place, the unknown word and the nearest known one.
pub fn validate_processor(
    processor: &Processor,
    path: &str,
    text: &str,
    knowledge: &Knowledge,
) -> Result<(), DataError> {
    let architectures: Vec<&str> = knowledge.library.names().collect();
    if let Some(name) = processor.architectures.iter().find(|name| !architectures.contains(&name.as_str())) {
        let reason = format!("unknown architecture `{name}`; {}", hint(name, &architectures));
        return Err(DataError::about_value(path, text, "architectures", name, reason));
    }
    let mut variables: BTreeSet<&str> = BTreeSet::from(["processor"]);
    let check = |key: &str, source: &str, expression: &Expression, variables: &BTreeSet<&str>| {
        let unknown = expression.references().paths.into_iter().filter_map(|path| path.into_iter().next());
        let Some(name) = unknown.into_iter().find(|name| !variables.contains(name.as_str())) else { return Ok(()) };
        let known: Vec<&str> = variables.iter().copied().collect();
        let reason = format!("unknown name `{name}`; {}", hint(&name, &known));
        Err(DataError::about_value(path, text, key, source, reason))
    };
    for item in &processor.lets {
        check("is", item.is.source(), &item.is, &variables)?;
        variables.insert(&item.name);
    }
    for run in &processor.add {
        if let Some(count) = &run.count {
            check("count", count.source(), count, &variables)?;
        }
        let mut numbered = variables.clone();
        numbered.insert("i");
        run.content.expressions().try_for_each(|e| check("content", run.content.source(), e, &numbered))?;
    }
    Ok(())
}
