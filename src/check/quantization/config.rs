//! Compares the quantisation that config.json declares with the other documents and with the tensor names.

use crate::checkpoint::files;
use std::collections::BTreeSet;

use serde_json::Value;

use super::module;
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place};
use crate::knowledge::quantization::{Scheme, block};

/// Documents that AutoGPTQ and AutoAWQ write beside config.json.
const BESIDE: [&str; 2] = [files::QUANTIZE_CONFIG, files::QUANT_CONFIG];

/// Parameters that decide shapes or the meaning of values, and how else they are spelled.
const PARAMETERS: [(&str, &str); 6] = [
    ("bits", "w_bit"),
    ("group_size", "q_group_size"),
    ("desc_act", "desc_act"),
    ("sym", "sym"),
    ("zero_point", "zero_point"),
    ("quant_method", "quant_method"),
];

/// The fault of a config with an unknown scheme.
pub(super) fn unknown(method: &str, config: &Value) -> Fault {
    let pointer = block(config).map_or("", |(pointer, _)| pointer);
    Fault::new(FaultKind::UnknownQuantization).at(Place::file(files::CONFIG).pointer(pointer)).with("method", method)
}

/// Parameters that a separate file states otherwise than config.json does.
pub(super) fn disagreements(checkpoint: &Checkpoint) -> Vec<Fault> {
    let Some((pointer, block)) = checkpoint.config().and_then(block) else { return Vec::new() };
    let mut faults = Vec::new();
    for name in BESIDE {
        let Some(Value::Object(beside)) = checkpoint.document(name).and_then(|d| d.value.as_ref()) else { continue };
        for (key, alias) in PARAMETERS {
            let spelled = |map: &Value| [key, alias].into_iter().find(|k| map.get(*k).is_some_and(|v| !v.is_null()));
            let other = Value::Object(beside.clone());
            let (Some(here), Some(there)) = (spelled(block), spelled(&other)) else { continue };
            let (said, otherwise) = (block.get(here), other.get(there));
            if said != otherwise {
                let fault = Fault::new(FaultKind::QuantizeConfigDisagrees)
                    .at(Place::file(name).pointer(format!("/{there}")))
                    .at(Place::file(files::CONFIG).pointer(format!("{pointer}/{here}")));
                faults.push(
                    fault
                        .with("parameter", key)
                        .with("said", said.cloned().unwrap_or_default())
                        .with("otherwise", otherwise.cloned().unwrap_or_default()),
                );
            }
        }
    }
    faults
}

/// The scheme whose tensors have these names, with a module that has all of them. Called where a config declares no scheme, and
/// for donors of merges.
#[must_use]
pub fn signature<'k, 'n>(
    schemes: &'k [Scheme],
    names: impl IntoIterator<Item = &'n str>,
) -> Option<(&'k Scheme, &'n str)> {
    let names: BTreeSet<&str> = names.into_iter().collect();
    module::signature(schemes, &names)
}

/// The fault of tensors with the endings of a scheme, under a config that declares none.
#[must_use]
pub fn undeclared<'n>(schemes: &[Scheme], names: impl IntoIterator<Item = &'n str>) -> Option<Fault> {
    let (scheme, module) = signature(schemes, names)?;
    let carrier = scheme.endings().next().unwrap_or_default();
    let at = Place::tensor(format!("{module}{carrier}"));
    Some(
        Fault::new(FaultKind::QuantizedUndeclared)
            .at(at)
            .with("scheme", scheme.summary.as_str())
            .with("module", module),
    )
}
