//! Tables of the names that the expressions of rules see.

use std::fmt::Write as _;

use ckpt_doctor::check::variables::{FUNCTIONS, VARIABLES};
use ckpt_doctor::checkpoint::FaultKind;

use super::markdown;

/// The variables and functions of every rule, and the details of each kind of fault.
pub fn tables() -> String {
    let mut out = "\n## Names in rules\n\n\
         A test compares every name in every rule with these tables. A value of a type *or null* may be null, and a key \
         with `?` may be missing: test it with `has(fault.key)`. A `let` binds a name that is none of these.\n\n\
         | variable | type | meaning |\n|---|---|---|\n"
        .to_owned();
    for variable in VARIABLES {
        let (name, value_type) = (variable.name, markdown(&variable.value_type.to_string()));
        let _ = writeln!(out, "| `{name}` | {value_type} | {} |", markdown(variable.about));
    }
    out.push_str(
        "\nFunctions take texts. Those of [all data files](../docs/recipes.md#functions) can be called too.\n\n\
         | function | type | result |\n|---|---|---|\n",
    );
    for function in FUNCTIONS {
        let (call, result) = (format!("{}({})", function.name, function.parameters.join(", ")), function.result);
        let _ = writeln!(out, "| `{call}` | {} | {} |", markdown(&result.to_string()), markdown(function.about));
    }
    out.push_str("\n## Details of faults\n\n| kind | details |\n|---|---|\n");
    let mut kinds = FaultKind::ALL.to_vec();
    kinds.sort_by_key(|kind| kind.name());
    for kind in kinds {
        let keys: Vec<String> = kind.details().iter().map(|key| format!("`{key}`")).collect();
        let _ = writeln!(out, "| `{}` | {} |", kind.name(), keys.join(", "));
    }
    out
}
