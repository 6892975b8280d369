//! Which loaders give NaN or infinity to the model: those whose class has the tensor.

use super::load::LoadReport;
use crate::checkpoint::files::Object;
use crate::checkpoint::{Fault, FaultKind};
use crate::knowledge::Loader;

/// Limits the fault of a weight that is not finite to the loaders that use the tensor, and says in `used` whether any does.
/// Called by the engine for each fault; `loads` are the whole reports. An adapter is used by every loader.
pub(super) fn under_users(fault: Fault, loads: &[LoadReport]) -> Fault {
    if fault.kind != FaultKind::NonFiniteWeights {
        return fault;
    }
    let place = fault.places.first();
    if place.and_then(|place| place.file.as_deref()).and_then(Object::reading) == Some(Object::Adapter) {
        return fault.with("used", true);
    }
    let tensor = place.and_then(|place| place.tensor.clone()).unwrap_or_default();
    let is_user = |version: &&str| loads.iter().any(|load| load.loader == **version && uses(load, &tensor));
    let users: Vec<&'static str> = Loader::ALL.into_iter().map(Loader::version).filter(is_user).collect();
    fault.with("used", !users.is_empty()).under_all(users)
}

/// Whether a loader reads the tensor into the model. The report may spell a name as the loader renames it, so the end of a
/// name is enough to be counted as unused.
fn uses(load: &LoadReport, tensor: &str) -> bool {
    let is_same = |name: &str| name == tensor || name.ends_with(tensor) || tensor.ends_with(name);
    let is_over = load.silent.iter().any(|silent| silent.name == tensor);
    !is_over && !load.unexpected.iter().any(|name| is_same(name))
}
