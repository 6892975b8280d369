//! Reads the fields of one header entry.

use super::{HeaderReader, too_large};
use crate::checkpoint::scan::{ScanError, Token};
use crate::checkpoint::shard::Dtype;
use crate::checkpoint::shard::entry::HeaderEntry;
use crate::checkpoint::text::escape;
use crate::checkpoint::{Fault, FaultKind, Place};

/// Maximum rank of a tensor, above that of any library; a shape with millions of dimensions only takes memory.
const MAX_RANK: usize = 1024;

/// Rank of usual tensors.
const USUAL_RANK: usize = 8;

/// Result of reading one field.
enum Field<T> {
    Absent,
    Bad,
    Good(T),
}

impl<T> Field<T> {
    fn ok(self) -> Option<T> {
        if let Self::Good(value) = self { Some(value) } else { None }
    }
}

impl HeaderReader<'_, '_, '_> {
    /// Reads the value of the entry `name`.
    pub(super) fn read_entry(&mut self, name: String) -> Result<(), ScanError> {
        let shard = self.shard;
        let place = || shard.place().in_tensor(name.clone());
        let malformed = |reason: &str| Fault::new(FaultKind::EntryMalformed).at(place()).with("reason", reason);
        if !self.budget.spend_entry(name.len()) {
            return Err(too_large());
        }
        let (mut dtype, mut shape, mut offsets) = (Field::Absent, Field::Absent, Field::Absent);
        let first = self.token()?;
        if first == Token::BeginObject {
            while let Token::Key(key) = self.token()? {
                let key = key.decode().0;
                let seen = match &*key {
                    "dtype" => !matches!(dtype, Field::Absent),
                    "shape" => !matches!(shape, Field::Absent),
                    "data_offsets" => !matches!(offsets, Field::Absent),
                    _ => false,
                };
                if seen {
                    self.faults.push(Fault::new(FaultKind::DuplicateHeaderKey).at(place()).with("key", &*key));
                }
                match &*key {
                    "dtype" => dtype = self.dtype(place)?,
                    "shape" => {
                        shape = self.numbers(MAX_RANK)?;
                        if matches!(shape, Field::Bad) {
                            self.faults.push(malformed("`shape` is not a list of natural numbers"));
                        }
                    }
                    "data_offsets" => {
                        offsets = match self.numbers(2)? {
                            Field::Good(numbers) => match numbers.as_slice() {
                                [begin, end] => Field::Good((*begin, *end)),
                                _ => Field::Bad,
                            },
                            _ => Field::Bad,
                        };
                        if matches!(offsets, Field::Bad) {
                            self.faults.push(malformed("`data_offsets` is not two natural numbers"));
                        }
                    }
                    _ => {
                        let value = self.token()?;
                        self.scanner.skip_rest_of(&value)?;
                    }
                }
            }
            let absent = [
                (matches!(dtype, Field::Absent), "it has no `dtype`"),
                (matches!(shape, Field::Absent), "it has no `shape`"),
                (matches!(offsets, Field::Absent), "it has no `data_offsets`"),
            ];
            for (_, reason) in absent.into_iter().filter(|(absent, _)| *absent) {
                self.faults.push(malformed(reason));
            }
        } else {
            self.scanner.skip_rest_of(&first)?;
            self.faults.push(malformed("it is not an object"));
        }
        self.entries.push(HeaderEntry { name, dtype: dtype.ok(), shape: shape.ok(), offsets: offsets.ok() });
        Ok(())
    }

    fn dtype(&mut self, place: impl Fn() -> Place) -> Result<Field<Dtype>, ScanError> {
        let token = self.token()?;
        let Token::String(text) = token else {
            self.scanner.skip_rest_of(&token)?;
            self.faults
                .push(Fault::new(FaultKind::EntryMalformed).at(place()).with("reason", "`dtype` is not a string"));
            return Ok(Field::Bad);
        };
        let name = text.decode().0;
        Ok(if let Some(dtype) = Dtype::from_name(&name) {
            Field::Good(dtype)
        } else {
            self.faults.push(Fault::new(FaultKind::UnknownDtype).at(place()).with("dtype", escape(&name, 40)));
            Field::Bad
        })
    }

    /// Reads a list of at most `cap` natural numbers.
    fn numbers(&mut self, cap: usize) -> Result<Field<Vec<u64>>, ScanError> {
        let first = self.token()?;
        if first != Token::BeginArray {
            self.scanner.skip_rest_of(&first)?;
            return Ok(Field::Bad);
        }
        let mut numbers = Vec::new();
        let mut good = true;
        loop {
            match self.token()? {
                Token::EndArray => break,
                Token::Number(literal) if good && numbers.len() < cap => match literal.parse() {
                    // A usual shape is part of the cost of a tensor.
                    Ok(_) if numbers.len() >= USUAL_RANK && !self.budget.spend_dimension() => return Err(too_large()),
                    Ok(number) if !literal.starts_with('-') => numbers.push(number),
                    _ => good = false,
                },
                other => {
                    good = false;
                    self.scanner.skip_rest_of(&other)?;
                }
            }
        }
        Ok(if good { Field::Good(numbers) } else { Field::Bad })
    }
}
