//! Imported attributes whose calls are modelled.

use super::element::Element;

/// What is known of an imported attribute.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Known {
    OrderedDict,
    /// A storage class.
    Storage(Element),
    /// `torch.storage.UntypedStorage`.
    Untyped,
    Dtype(Element),
    /// `_rebuild_tensor`, with the number of its arguments.
    Rebuild,
    RebuildV2,
    RebuildV3,
    RebuildParameter,
    Size,
    /// `torch.serialization._get_layout`, whose result only sparse tensors have.
    Layout,
    /// `builtins.getattr`.
    Getattr,
    /// Anything else.
    Other,
}

impl Known {
    pub(super) fn new(module: &str, name: &str) -> Self {
        let known = match (module, name) {
            ("collections", "OrderedDict") => Some(Self::OrderedDict),
            ("torch.storage", "UntypedStorage") => Some(Self::Untyped),
            ("torch._utils", "_rebuild_tensor") => Some(Self::Rebuild),
            ("torch._utils", "_rebuild_tensor_v2") => Some(Self::RebuildV2),
            ("torch._utils", "_rebuild_tensor_v3") => Some(Self::RebuildV3),
            ("torch._utils", "_rebuild_parameter") => Some(Self::RebuildParameter),
            ("torch", "Size") => Some(Self::Size),
            ("torch.serialization", "_get_layout") => Some(Self::Layout),
            ("builtins", "getattr") => Some(Self::Getattr),
            ("torch" | "torch.cuda", name) if name.ends_with("Storage") => Element::of_storage(name).map(Self::Storage),
            ("torch", name) => Element::of_dtype(name).map(Self::Dtype),
            _ => None,
        };
        known.unwrap_or(Self::Other)
    }
}
