//! The entry of a tensor in manifests of versions 1 to 5. Before version 5, it had one source and one transform.

use serde::Deserialize;

use super::RecordedTensor;
use crate::checkpoint::Dtype;
use crate::merge::donor_tensor::DonorTensor;
use crate::surgery::expr::{NewValues, TensorExpr, TensorTransform};
use crate::surgery::tensor_ref::RowSlice;

/// An entry of any version.
#[derive(Debug, Deserialize)]
pub(super) struct TensorEntry {
    name: String,
    shard: String,
    dtype: String,
    shape: Vec<u64>,
    /// Version 2 calls it `sha256`, version 1 has none.
    #[serde(alias = "sha256")]
    digest: Option<String>,
    transform: TensorTransform,
    /// Before version 5.
    scale: Option<f64>,
    /// Version 4.
    values: Option<NewValues>,
    source: EntrySource,
}

/// The source of a tensor.
#[derive(Debug, Deserialize)]
#[serde(untagged, expecting = "its source is neither a tensor of a donor nor a known operation")]
enum EntrySource {
    /// Before version 5: the only one.
    Only(OnlySource),
    /// Since version 5.
    Expression(TensorExpr<DonorTensor>),
}

/// The donor tensor of an entry before version 5.
#[derive(Debug, Deserialize)]
struct OnlySource {
    donor: String,
    name: String,
    /// Version 1 has none, and knew no casts.
    dtype: Option<String>,
    shape: Vec<u64>,
    slice: Option<RowSlice>,
    #[serde(alias = "sha256")]
    digest: Option<String>,
}

impl TryFrom<TensorEntry> for RecordedTensor {
    type Error = String;

    fn try_from(entry: TensorEntry) -> Result<Self, String> {
        let TensorEntry { name, shard, dtype, shape, digest, transform, scale, values, source } = entry;
        let source = match source {
            EntrySource::Expression(source) if source.transform() == transform => source,
            EntrySource::Expression(source) => {
                let word = source.transform().name();
                return Err(format!("{name:?} is recorded as {} and its source as {word}", transform.name()));
            }
            EntrySource::Only(one) => {
                let to = Dtype::from_name(&dtype).ok_or_else(|| format!("no element type {dtype:?}"))?;
                let values = values.unwrap_or(NewValues::former(&shape));
                one.expression(transform, (to, &shape), scale, values)
            }
        };
        Ok(Self { name, shard, dtype, shape, digest, source })
    }
}

impl OnlySource {
    /// The expression that an entry before version 5 means, for a result of this type and shape.
    fn expression(
        self,
        transform: TensorTransform,
        (to, shape): (Dtype, &[u64]),
        scale: Option<f64>,
        values: NewValues,
    ) -> TensorExpr<DonorTensor> {
        let Self { donor, name, dtype, shape: own, slice, digest } = self;
        let dtype = dtype.unwrap_or_else(|| to.name().to_owned());
        let from = Dtype::from_name(&dtype);
        let of = DonorTensor { donor, name, dtype, shape: own, slice, digest };
        let rows = shape.first().copied().unwrap_or_default();
        let shape = shape.to_vec();
        let fitted = match transform {
            TensorTransform::GrowRows => TensorExpr::GrowRows { of, rows },
            TensorTransform::SampleRows => TensorExpr::SampleRows { of, rows },
            TensorTransform::Pad => TensorExpr::Pad { of, shape },
            TensorTransform::Reinit => {
                return TensorExpr::Initialise { values, dtype: to, shape, instead_of: of };
            }
            // No version before 5 added products.
            TensorTransform::Copy
            | TensorTransform::Convert
            | TensorTransform::NewRows
            | TensorTransform::Map
            | TensorTransform::AddProduct => TensorExpr::Stored(of),
        };
        match from {
            Some(from) => fitted.converted(from, scale, to),
            None => TensorExpr::Cast { of: Box::new(fitted), to },
        }
    }
}
