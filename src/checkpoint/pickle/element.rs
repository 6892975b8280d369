//! Element types of storages and tensors in pickles.

use crate::checkpoint::Dtype;

/// An element type by its width; `dtype` is `None` for one that safetensors lacks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Element {
    pub(super) dtype: Option<Dtype>,
    /// Bytes of one element.
    pub(super) width: u64,
    /// Whether a tensor of it can require a gradient.
    pub(super) is_differentiable: bool,
}

/// Storage classes and dtypes, both below the module `torch`. Source: `_dtype_to_storage_type_map` and `_new_dtypes` in
/// `torch/storage.py`, 2.15.0. Quantised types, which share a storage class with no plain tensor, are left out.
const ELEMENTS: [(&str, &str, Option<Dtype>, u64); 21] = [
    ("DoubleStorage", "float64", Some(Dtype::F64), 8),
    ("FloatStorage", "float32", Some(Dtype::F32), 4),
    ("HalfStorage", "float16", Some(Dtype::F16), 2),
    ("BFloat16Storage", "bfloat16", Some(Dtype::BF16), 2),
    ("ComplexDoubleStorage", "complex128", None, 16),
    ("ComplexFloatStorage", "complex64", Some(Dtype::C64), 8),
    ("LongStorage", "int64", Some(Dtype::I64), 8),
    ("IntStorage", "int32", Some(Dtype::I32), 4),
    ("ShortStorage", "int16", Some(Dtype::I16), 2),
    ("CharStorage", "int8", Some(Dtype::I8), 1),
    ("ByteStorage", "uint8", Some(Dtype::U8), 1),
    ("BoolStorage", "bool", Some(Dtype::BOOL), 1),
    ("", "uint16", Some(Dtype::U16), 2),
    ("", "uint32", Some(Dtype::U32), 4),
    ("", "uint64", Some(Dtype::U64), 8),
    ("", "complex32", None, 4),
    ("", "float8_e5m2", Some(Dtype::F8_E5M2), 1),
    ("", "float8_e4m3fn", Some(Dtype::F8_E4M3), 1),
    ("", "float8_e5m2fnuz", Some(Dtype::F8_E5M2FNUZ), 1),
    ("", "float8_e4m3fnuz", Some(Dtype::F8_E4M3FNUZ), 1),
    ("", "float8_e8m0fnu", Some(Dtype::F8_E8M0), 1),
];

impl Element {
    /// Bytes without a type, of `torch.storage.UntypedStorage`.
    pub(super) const BYTES: Self = Self { dtype: Some(Dtype::U8), width: 1, is_differentiable: false };

    /// The type of a storage class: `FloatStorage`.
    pub(super) fn of_storage(class: &str) -> Option<Self> {
        ELEMENTS.iter().find(|(storage, ..)| !storage.is_empty() && *storage == class).map(Self::new)
    }

    /// The type of this name in `torch`: `float8_e4m3fn`.
    pub(super) fn of_dtype(name: &str) -> Option<Self> {
        ELEMENTS.iter().find(|(_, dtype, ..)| *dtype == name).map(Self::new)
    }

    fn new((_, name, dtype, width): &(&str, &str, Option<Dtype>, u64)) -> Self {
        let is_differentiable = name.contains("float") || name.contains("complex");
        Self { dtype: *dtype, width: *width, is_differentiable }
    }
}
