//! The penalty of a map: the one that predicts words best on which the map was not fitted.

use std::io;

use super::algebra::dot;
use super::{EmbeddingRows, FittedMap};
use crate::surgery::donor::DonorFile;
use crate::surgery::error::{ApplyError, io_at};
use crate::surgery::expr::WordMap;
use crate::surgery::tensor_ref::TensorRef;

/// Penalties that are tried.
const RIDGES: [f64; 6] = [0.03, 0.1, 0.3, 1.0, 3.0, 10.0];

/// How well a map predicts words on which it was not fitted.
#[derive(Debug, Clone, Copy)]
pub struct WordPrediction {
    /// Mean cosine of a predicted row and the word's own, both less the mean.
    pub cosine: f64,
    /// The same for the row of another word.
    pub shuffled: f64,
    /// Root of the mean square of the predicted rows, in proportion to that of the words' own.
    pub size: f64,
}

/// The map with the penalty that predicts the words that were left out best. `word_fit` of recipes calls it.
///
/// # Errors
/// [`ApplyError`] when a file cannot be opened or read, or the rows determine no map.
pub fn choose(
    map: WordMap<TensorRef>,
    left_out: &[[u64; 2]],
) -> Result<(WordMap<TensorRef>, WordPrediction), ApplyError> {
    map.widths().map_err(|reason| failed(&map)(io::Error::new(io::ErrorKind::InvalidInput, reason)))?;
    let files = [DonorFile::open(&map.from.path)?, DonorFile::open(&map.to.path)?];
    let mut read = |of: &TensorRef, at: u64, buffer: &mut [u8]| {
        let file = files.iter().zip([&map.from, &map.to]).find(|(_, whole)| whole.path == of.path);
        let (file, _) = file.ok_or(io::ErrorKind::NotFound)?;
        file.read_at(buffer, of.offset.saturating_add(at))
    };
    let mut tried = || -> io::Result<(f64, WordPrediction)> {
        let mut fitted = FittedMap::sums(&mut read, &map)?;
        let (mut x, mut y) = (Vec::new(), Vec::new());
        let side = |side: usize| left_out.iter().map(move |word| word.get(side).copied().unwrap_or_default());
        EmbeddingRows::of(&map.from)?.extend(&mut read, side(0), &vec![0.0; fitted.from.len()], &mut x)?;
        EmbeddingRows::of(&map.to)?.extend(&mut read, side(1), &vec![0.0; fitted.to.len()], &mut y)?;
        let mut best: Option<(f64, WordPrediction)> = None;
        for ridge in RIDGES {
            fitted.penalise(ridge)?;
            let prediction = predicted(&fitted.points(&x, 1.0), &y, &fitted.to);
            if best.as_ref().is_none_or(|(_, found)| prediction.cosine > found.cosine) {
                best = Some((ridge, prediction));
            }
        }
        best.ok_or_else(|| io::ErrorKind::InvalidData.into())
    };
    let (ridge, prediction) = tried().map_err(failed(&map))?;
    Ok((WordMap { ridge, ..map }, prediction))
}

/// An error while the rows of the first embedding are read.
fn failed(map: &WordMap<TensorRef>) -> impl FnOnce(io::Error) -> ApplyError {
    io_at(&map.from.path, "reading")
}

/// Compares predicted rows with the words' own.
pub(super) fn predicted(guessed: &[f64], own: &[f64], mean: &[f64]) -> WordPrediction {
    let width = mean.len().max(1);
    let centred = |row: &[f64]| row.iter().zip(mean).map(|(value, mean)| value - mean).collect::<Vec<_>>();
    let rows = |of: &[f64]| of.chunks_exact(width).map(centred).collect::<Vec<_>>();
    let (guesses, truths) = (rows(guessed), rows(own));
    #[expect(clippy::cast_precision_loss, reason = "a vocabulary has far fewer than 2^52 words")]
    let count = truths.len().max(1) as f64;
    let cosines = |shift: usize| {
        let others = truths.iter().cycle().skip(shift);
        guesses.iter().zip(others).map(|(guess, truth)| cosine(guess, truth)).sum::<f64>() / count
    };
    let squares = |of: &[f64]| of.iter().map(|value| value * value).sum::<f64>();
    WordPrediction { cosine: cosines(0), shuffled: cosines(1), size: (squares(guessed) / squares(own)).sqrt() }
}

fn cosine(a: &[f64], b: &[f64]) -> f64 {
    let cosine = dot(a, b) / (dot(a, a) * dot(b, b)).sqrt();
    if cosine.is_finite() { cosine } else { 0.0 }
}
