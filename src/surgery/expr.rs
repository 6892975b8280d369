//! How the values of a planned tensor are made: an expression over ranges of donors' files.
//!
//! A plan has one for each tensor, over [`TensorRef`]s. A manifest has the same one over records of donors' tensors, so that
//! `verify` reads it and makes the tensor again. [`super::transform`] evaluates it in blocks.

use std::convert::Infallible;

use serde::{Deserialize, Serialize};

use super::tensor_ref::TensorRef;
use super::values::can_compute;
use crate::checkpoint::{Dtype, byte_len};

/// Maximum number of values in the two factors of a product. They are held in memory as binary32 numbers, so in 512 MiB: factors of
/// rank 256 of a matrix with 500 000 rows.
const MAX_FACTORS: u64 = 1 << 27;

/// Maximum number of values in the matrices of a map. They are binary64 numbers, so 512 MiB: from 4096 to 8192 dimensions.
const MAX_MAP: u64 = 1 << 26;

/// Maximum number of words on which a map is fitted. Each adds its products to every value of the matrices.
const MAX_WORDS: usize = 1 << 14;

/// An expression for the values of a tensor; `S` names a donor's tensor, or some of its rows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum TensorExpr<S> {
    /// The donor's bytes as they are.
    Stored(S),
    /// The donor's rows, then rows that hold their mean.
    GrowRows {
        /// The donor's rows.
        of: S,
        /// Number of rows in the result.
        rows: u64,
    },
    /// The donor's rows, then seeded random rows with their mean and, times 1e-9, their covariance.
    SampleRows {
        /// The donor's rows.
        of: S,
        /// Number of rows in the result.
        rows: u64,
    },
    /// Rows with the mean of another tensor's rows, in place of a donor's tensor.
    #[serde(rename_all = "kebab-case")]
    NewRows {
        /// The other tensor.
        like: S,
        /// Number of rows in the result.
        rows: u64,
        /// Whether they are seeded random rows, which have the covariance of those rows times 1e-9, too.
        sampled: bool,
        /// The donor tensor that is not used.
        instead_of: S,
    },
    /// The donor's values in the leading corner, zeros elsewhere.
    Pad {
        /// The donor's values.
        of: S,
        /// Shape of the result.
        shape: Vec<u64>,
    },
    /// The donor's values in the space of another language model's embedding.
    Map {
        /// The donor's values.
        of: S,
        /// Which of them are a point or a direction in the space of the first embedding.
        values: Mapped,
        /// A constant by which they are multiplied before.
        before: f64,
        /// A constant by which they are multiplied after it.
        after: f64,
        /// The type to which they are rounded then.
        #[cfg_attr(test, schemars(with = "String"))]
        to: Dtype,
        /// The map.
        map: Box<WordMap<S>>,
    },
    /// The values that the class gives to a new model; random ones are seeded with the name of the tensor.
    #[serde(rename_all = "kebab-case")]
    Initialise {
        /// The values.
        values: NewValues,
        /// Their type.
        #[cfg_attr(test, schemars(with = "String"))]
        dtype: Dtype,
        /// Their shape.
        shape: Vec<u64>,
        /// The donor tensor that is not used.
        instead_of: S,
    },
    /// Values rounded to another type.
    Cast {
        /// The values.
        of: Box<Self>,
        /// The type.
        #[cfg_attr(test, schemars(with = "String"))]
        to: Dtype,
    },
    /// Values multiplied by a constant; products are computed in binary64 and rounded once.
    Scale {
        /// The values.
        of: Box<Self>,
        /// The constant.
        by: f64,
        /// Type of the products.
        #[cfg_attr(test, schemars(with = "String"))]
        to: Dtype,
    },
    /// A matrix, to which a product of two others is added.
    AddProduct {
        /// The matrix, whose type is that of the result.
        to: Box<Self>,
        /// The product.
        product: Product<S>,
    },
}

/// How a tensor lies in the space of an embedding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Mapped {
    /// Each column is a direction: the weight of a projector.
    Columns,
    /// It is a point: the bias of a projector.
    Point,
    /// Each row is a point: more rows of the embedding.
    Rows,
}

/// A linear map between the rows of two embeddings, fitted on words that both vocabularies have ([`super::word_map`]).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct WordMap<S> {
    /// The embedding from which it leads.
    pub from: S,
    /// The embedding to which it leads.
    pub to: S,
    /// The rows of each word in the two.
    pub words: Vec<[u64; 2]>,
    /// Weight of the penalty on large maps, in proportion to the mean variance of the first embedding.
    pub ridge: f64,
}

/// The values of a tensor that starts again, as its class gives them to a new model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub enum NewValues {
    /// Zeros: biases, and norms that add 1 to their weight.
    Zeros,
    /// Ones: the weights of other norms.
    Ones,
    /// Seeded normal values with mean 0 and this standard deviation.
    Normal(f64),
    /// Seeded values that are evenly spread between the negative of this number and the number.
    Uniform(f64),
}

impl NewValues {
    /// The values that manifests before version 4 mean by `reinit`: they did not record any.
    #[must_use]
    pub const fn former(shape: &[u64]) -> Self {
        if shape.len() < 2 { Self::Zeros } else { Self::Normal(0.02) }
    }

    /// Whether the number can be that of a distribution; one in a manifest may be anything.
    #[must_use]
    pub fn is_possible(self) -> bool {
        match self {
            Self::Zeros | Self::Ones => true,
            Self::Normal(size) | Self::Uniform(size) => size.is_finite() && size > 0.0,
        }
    }

    /// What reports call them: `zeros`, `normal 0.02`.
    #[must_use]
    pub fn words(self) -> String {
        match self {
            Self::Zeros => "zeros".to_owned(),
            Self::Ones => "ones".to_owned(),
            Self::Normal(deviation) => format!("normal {deviation:.3}"),
            Self::Uniform(limit) => format!("uniform {limit:.3}"),
        }
    }
}

/// A constant multiple of a product of two matrices. Its values are binary32: sums are computed in binary64 and rounded, then
/// multiplied.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Product<S> {
    /// The first factor, with the rows of the product.
    pub left: Factor<S>,
    /// The second factor, with the columns of the product.
    pub right: Factor<S>,
    /// The constant.
    pub scale: f64,
    /// Whether the values are rounded to the type of the matrix before they are added to it; otherwise the sum is rounded.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub rounded: bool,
}

/// A factor of a product: a donor's matrix. Its values are rounded to binary32.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Factor<S> {
    /// The matrix.
    Stored(S),
    /// Its rows as columns.
    Transposed(S),
}

/// What an expression does to the values of a donor, in one word for reports: all of them except [`Self::Copy`] and
/// [`Self::Reinit`] may also scale and cast.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum TensorTransform {
    /// The donor's bytes as they are.
    Copy,
    /// The donor's values in their shape, scaled or cast.
    Convert,
    /// The donor's rows, then rows that hold their mean.
    GrowRows,
    /// The donor's rows, then seeded random rows with their mean and, times 1e-9, their covariance.
    SampleRows,
    /// Rows with the mean of another tensor's rows, perhaps random ones, in place of the donor's.
    NewRows,
    /// The donor's values in the leading corner, zeros elsewhere.
    Pad,
    /// The donor's values in the space of another language model's embedding.
    Map,
    /// The values that the class gives to a new model.
    Reinit,
    /// The donor's values plus a product of two matrices of another donor.
    AddProduct,
}

impl TensorTransform {
    /// The name in recipes, options and reports.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Copy => "copy",
            Self::Convert => "convert",
            Self::GrowRows => "grow-rows",
            Self::SampleRows => "sample-rows",
            Self::NewRows => "new-rows",
            Self::Pad => "pad",
            Self::Map => "map",
            Self::Reinit => "reinit",
            Self::AddProduct => "add-product",
        }
    }
}

impl<S> Factor<S> {
    /// The donor's matrix.
    pub const fn of(&self) -> &S {
        match self {
            Self::Stored(of) | Self::Transposed(of) => of,
        }
    }

    fn try_map<T, E>(&self, to: &mut dyn FnMut(&S) -> Result<T, E>) -> Result<Factor<T>, E> {
        Ok(match self {
            Self::Stored(of) => Factor::Stored(to(of)?),
            Self::Transposed(of) => Factor::Transposed(to(of)?),
        })
    }
}

impl<S> TensorExpr<S> {
    /// The values multiplied, or cast where the type differs.
    #[must_use]
    pub fn converted(self, from: Dtype, scale: Option<f64>, to: Dtype) -> Self {
        match scale {
            Some(by) => Self::Scale { of: Box::new(self), by, to },
            None if from != to => Self::Cast { of: Box::new(self), to },
            None => self,
        }
    }

    /// The donors' tensors, in the order in which [`Self::try_map`] visits them: the one that the result stands for comes first.
    pub fn sources(&self) -> Vec<&S> {
        match self {
            Self::Stored(of)
            | Self::GrowRows { of, .. }
            | Self::SampleRows { of, .. }
            | Self::Pad { of, .. }
            | Self::Initialise { instead_of: of, .. } => vec![of],
            Self::NewRows { like, instead_of, .. } => vec![instead_of, like],
            Self::Map { of, map, .. } => vec![of, &map.from, &map.to],
            Self::Cast { of, .. } | Self::Scale { of, .. } => of.sources(),
            Self::AddProduct { to, product } => {
                let mut sources = to.sources();
                sources.extend([product.left.of(), product.right.of()]);
                sources
            }
        }
    }

    /// The donor tensor that the result stands for: the first of [`Self::sources`].
    pub fn main(&self) -> &S {
        match self {
            Self::Stored(of)
            | Self::GrowRows { of, .. }
            | Self::SampleRows { of, .. }
            | Self::Pad { of, .. }
            | Self::Map { of, .. }
            | Self::Initialise { instead_of: of, .. }
            | Self::NewRows { instead_of: of, .. } => of,
            Self::Cast { of, .. } | Self::Scale { of, .. } | Self::AddProduct { to: of, .. } => of.main(),
        }
    }

    /// The donor's tensor, if its bytes are the result; the kernel can then copy them.
    pub const fn copied(&self) -> Option<&S> {
        match self {
            Self::Stored(of) => Some(of),
            _ => None,
        }
    }

    /// What it does, in one word.
    #[must_use]
    pub fn transform(&self) -> TensorTransform {
        match self {
            Self::Stored(_) => TensorTransform::Copy,
            Self::GrowRows { .. } => TensorTransform::GrowRows,
            Self::SampleRows { .. } => TensorTransform::SampleRows,
            Self::NewRows { .. } => TensorTransform::NewRows,
            Self::Pad { .. } => TensorTransform::Pad,
            Self::Map { .. } => TensorTransform::Map,
            Self::Initialise { .. } => TensorTransform::Reinit,
            Self::AddProduct { .. } => TensorTransform::AddProduct,
            Self::Cast { of, .. } | Self::Scale { of, .. } => match of.transform() {
                TensorTransform::Copy => TensorTransform::Convert,
                other => other,
            },
        }
    }

    /// The constant factor on all values, or on the product that is added to them; `None` for a map with the factor 1.
    #[must_use]
    #[expect(clippy::float_cmp, reason = "a factor of exactly 1 changes nothing")]
    pub fn scale(&self) -> Option<f64> {
        match self {
            Self::Scale { by, .. } => Some(*by),
            Self::Map { after, .. } => Some(*after).filter(|by| *by != 1.0),
            Self::AddProduct { product, .. } => Some(product.scale),
            Self::Cast { of, .. } => of.scale(),
            _ => None,
        }
    }

    /// The values that it starts again with.
    #[must_use]
    pub const fn values(&self) -> Option<NewValues> {
        match self {
            Self::Initialise { values, .. } => Some(*values),
            _ => None,
        }
    }

    /// The same expression over other names of the donors' tensors.
    ///
    /// # Errors
    /// The first error of `to`.
    pub fn try_map<T, E>(&self, to: &mut dyn FnMut(&S) -> Result<T, E>) -> Result<TensorExpr<T>, E> {
        Ok(match self {
            Self::Stored(of) => TensorExpr::Stored(to(of)?),
            Self::GrowRows { of, rows } => TensorExpr::GrowRows { of: to(of)?, rows: *rows },
            Self::SampleRows { of, rows } => TensorExpr::SampleRows { of: to(of)?, rows: *rows },
            Self::NewRows { like, rows, sampled, instead_of } => {
                let instead_of = to(instead_of)?;
                TensorExpr::NewRows { like: to(like)?, rows: *rows, sampled: *sampled, instead_of }
            }
            Self::Pad { of, shape } => TensorExpr::Pad { of: to(of)?, shape: shape.clone() },
            Self::Map { of, values, before, after, to: dtype, map } => {
                let of = to(of)?;
                let map =
                    WordMap { from: to(&map.from)?, to: to(&map.to)?, words: map.words.clone(), ridge: map.ridge };
                TensorExpr::Map { of, values: *values, before: *before, after: *after, to: *dtype, map: Box::new(map) }
            }
            Self::Initialise { values, dtype, shape, instead_of } => TensorExpr::Initialise {
                values: *values,
                dtype: *dtype,
                shape: shape.clone(),
                instead_of: to(instead_of)?,
            },
            Self::Cast { of, to: dtype } => TensorExpr::Cast { of: Box::new(of.try_map(to)?), to: *dtype },
            Self::Scale { of, by, to: dtype } => {
                TensorExpr::Scale { of: Box::new(of.try_map(to)?), by: *by, to: *dtype }
            }
            Self::AddProduct { to: of, product } => TensorExpr::AddProduct {
                to: Box::new(of.try_map(to)?),
                product: Product {
                    left: product.left.try_map(to)?,
                    right: product.right.try_map(to)?,
                    scale: product.scale,
                    rounded: product.rounded,
                },
            },
        })
    }

    /// [`Self::try_map`] with a function that cannot fail.
    #[must_use]
    pub fn map<T>(&self, to: &mut dyn FnMut(&S) -> T) -> TensorExpr<T> {
        let Ok(mapped) = self.try_map(&mut |of| Ok::<T, Infallible>(to(of)));
        mapped
    }
}

/// Type and shape of values.
pub type Typed = (Dtype, Vec<u64>);

impl TensorExpr<TensorRef> {
    /// Number of seeded random rows; `None` without any.
    #[must_use]
    pub(super) fn sampled_rows(&self) -> Option<u64> {
        match self {
            Self::SampleRows { of, rows } => Some(rows.saturating_sub(of.shape.first().copied().unwrap_or_default())),
            Self::NewRows { rows, sampled: true, .. } => Some(*rows),
            Self::Cast { of, .. } | Self::Scale { of, .. } => of.sampled_rows(),
            _ => None,
        }
    }

    /// Type and shape of the values.
    ///
    /// # Errors
    /// Why they cannot be made: the operands do not fit the operation. A planner prevents it; an expression of a manifest may be
    /// anything.
    pub fn typed(&self) -> Result<Typed, String> {
        match self {
            Self::Stored(of) => Ok((of.dtype, of.shape.clone())),
            Self::GrowRows { of, rows } | Self::SampleRows { of, rows } => {
                computable(of.dtype)?;
                let mut shape = of.shape.clone();
                let first = shape.first_mut().filter(|first| **first <= *rows);
                *first.ok_or_else(|| format!("{:?} cannot grow to {rows} rows", of.shape))? = *rows;
                Ok((of.dtype, shape))
            }
            Self::NewRows { like, rows, .. } => {
                computable(like.dtype)?;
                let mut shape = like.shape.clone();
                *shape.first_mut().ok_or("a number has no rows")? = *rows;
                Ok((like.dtype, shape))
            }
            Self::Pad { of, shape } => {
                computable(of.dtype)?;
                let nests =
                    of.shape.len() == shape.len() && of.shape.iter().zip(shape).all(|(have, want)| have <= want);
                if nests { Ok((of.dtype, shape.clone())) } else { Err(format!("{:?} cannot be padded", of.shape)) }
            }
            Self::Map { of, values, before, after, to: dtype, map } => {
                computable(of.dtype).and_then(|()| computable(*dtype))?;
                let [from, to] = map.widths()?;
                let shape = match (values, of.shape.as_slice()) {
                    (Mapped::Columns, &[width, columns]) if width == from => vec![to, columns],
                    (Mapped::Point, &[width]) if width == from => vec![to],
                    (Mapped::Rows, &[rows, width]) if width == from => vec![rows, to],
                    _ => return Err(format!("{:?} is not in a space of {from} dimensions", of.shape)),
                };
                let is_factor = |by: &&f64| by.is_finite() && **by != 0.0;
                match [before, after].into_iter().find(|by| !is_factor(by)) {
                    None => Ok((*dtype, shape)),
                    Some(by) => Err(format!("{by} is no factor")),
                }
            }
            Self::Initialise { values, dtype, shape, .. } => {
                computable(*dtype)?;
                if values.is_possible() { Ok((*dtype, shape.clone())) } else { Err("no distribution".to_owned()) }
            }
            Self::Cast { of, to } => {
                let (from, shape) = of.typed()?;
                computable(from).and_then(|()| computable(*to))?;
                Ok((*to, shape))
            }
            Self::Scale { of, by, to } => {
                let (from, shape) = of.typed()?;
                computable(from).and_then(|()| computable(*to))?;
                let is_factor = by.is_finite() && *by != 0.0;
                if is_factor { Ok((*to, shape)) } else { Err(format!("{by} is no factor")) }
            }
            Self::AddProduct { to, product } => {
                let (dtype, shape) = to.typed()?;
                if to.transform() == TensorTransform::AddProduct {
                    return Err("more than one product is added".to_owned());
                }
                product.fits(dtype, &shape)?;
                Ok((dtype, shape))
            }
        }
    }
}

impl WordMap<TensorRef> {
    /// The widths of the two embeddings.
    ///
    /// # Errors
    /// Why no map can be fitted.
    pub(super) fn widths(&self) -> Result<[u64; 2], String> {
        let (&[from_rows, from], &[to_rows, to]) = (self.from.shape.as_slice(), self.to.shape.as_slice()) else {
            return Err("an embedding is no matrix".to_owned());
        };
        computable(self.from.dtype).and_then(|()| computable(self.to.dtype))?;
        let is_there = |word: &[u64; 2]| matches!(*word, [x, y] if x < from_rows && y < to_rows);
        if self.words.len() < 2 || !self.words.iter().all(is_there) {
            return Err("the embeddings do not have the rows of the words".to_owned());
        }
        if self.words.len() > MAX_WORDS {
            return Err(format!("a map of {} words; at most {MAX_WORDS} are read", self.words.len()));
        }
        // Σ x xᵀ twice, and Σ y xᵀ.
        let values = from.saturating_mul(from).saturating_mul(2).saturating_add(to.saturating_mul(from));
        if values > MAX_MAP || from == 0 {
            return Err(format!("a map from {from} to {to} dimensions is too large"));
        }
        let is_possible = self.ridge.is_finite() && self.ridge > 0.0;
        if is_possible { Ok([from, to]) } else { Err(format!("{} is no penalty", self.ridge)) }
    }
}

impl Factor<TensorRef> {
    /// Rows and columns.
    pub(super) fn shape(&self) -> Option<[u64; 2]> {
        match (self, self.of().shape.as_slice()) {
            (Self::Stored(_), &[rows, columns]) | (Self::Transposed(_), &[columns, rows]) => Some([rows, columns]),
            _ => None,
        }
    }
}

impl Product<TensorRef> {
    /// Fails unless it can be added to a matrix of this type and shape.
    fn fits(&self, dtype: Dtype, shape: &[u64]) -> Result<(), String> {
        let (left, right) = (&self.left, &self.right);
        for factor in [left, right] {
            computable(factor.of().dtype)?;
        }
        if !matches!(dtype, Dtype::F16 | Dtype::BF16 | Dtype::F32) {
            return Err(format!("products are added to F16, BF16 and F32, not to {dtype}"));
        }
        let (Some([rows, inner]), Some([other, columns])) = (left.shape(), right.shape()) else {
            return Err("a factor is no matrix".to_owned());
        };
        if inner != other || *shape != [rows, columns] {
            return Err(format!("[{rows}, {inner}] times [{other}, {columns}] is not {shape:?}"));
        }
        let values = [left, right].map(|factor| byte_len(Dtype::U8, &factor.of().shape).unwrap_or(u64::MAX));
        if values.iter().fold(0, |sum: u64, n| sum.saturating_add(*n)) > MAX_FACTORS {
            return Err(format!("its factors have more than {MAX_FACTORS} values"));
        }
        if self.scale.is_finite() { Ok(()) } else { Err(format!("{} is no factor", self.scale)) }
    }
}

fn computable(dtype: Dtype) -> Result<(), String> {
    if can_compute(dtype) { Ok(()) } else { Err(format!("values of type {dtype} can only be copied")) }
}
