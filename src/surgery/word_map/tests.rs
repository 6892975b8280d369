#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "tests")]

use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use super::choice::predicted;
use super::*;

const FROM: usize = 7;
const TO: usize = 11;
const WORDS: usize = 200;

/// Tensors in memory, by name.
#[derive(Default)]
struct Files(BTreeMap<String, Vec<u8>>);

impl Files {
    fn add(&mut self, name: &str, shape: &[usize], values: &[f64]) -> TensorRef {
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        let len = bytes.len() as u64;
        self.0.insert(name.to_owned(), bytes);
        TensorRef {
            donor: "a".to_owned(),
            path: name.into(),
            name: name.to_owned(),
            dtype: Dtype::F64,
            shape: shape.iter().map(|n| *n as u64).collect(),
            offset: 0,
            len,
            slice: None,
        }
    }

    fn read(&self) -> impl FnMut(&TensorRef, u64, &mut [u8]) -> io::Result<()> {
        |of, at, buffer| {
            let at = usize::try_from(at).unwrap();
            buffer.copy_from_slice(&self.0[&of.name][at..][..buffer.len()]);
            Ok(())
        }
    }
}

fn normal(rng: &mut ChaCha8Rng, count: usize) -> Vec<f64> {
    (0..count).map(|_| StandardNormal.sample(rng)).collect()
}

/// `matrix`, of `columns` columns, times each row of `rows`.
fn times(matrix: &[f64], columns: usize, rows: &[f64]) -> Vec<f64> {
    let product = |row: &[f64]| {
        matrix.chunks(columns).map(|line| line.iter().zip(row).map(|(a, b)| a * b).sum()).collect::<Vec<f64>>()
    };
    rows.chunks(columns).flat_map(product).collect()
}

/// Embeddings of which the second one is a map of the first, with noise, and the map with its shift.
fn embeddings(files: &mut Files, noise: f64) -> (WordMap<TensorRef>, Vec<f64>, Vec<f64>) {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let (map, shift) = (normal(&mut rng, TO * FROM), normal(&mut rng, TO));
    let x: Vec<f64> = normal(&mut rng, WORDS * FROM).iter().map(|value| value + 0.5).collect();
    let mut y = times(&map, FROM, &x);
    for row in y.chunks_mut(TO) {
        row.iter_mut().zip(&shift).for_each(|(value, shift)| *value += shift + noise * normal(&mut rng, 1)[0]);
    }
    let (from, to) = (files.add("from", &[WORDS, FROM], &x), files.add("to", &[WORDS, TO], &y));
    let words = (0..WORDS as u64).map(|i| [i, i]).collect();
    (WordMap { from, to, words, ridge: 1e-9 }, map, shift)
}

fn written(files: &Files, of: &TensorRef, values: Mapped, before: f64, map: &WordMap<TensorRef>) -> Vec<f64> {
    let mut out = Vec::new();
    let how = MappedAs { values, before, after: 0.5, to: Dtype::F64 };
    assert_eq!(write(&mut files.read(), of, how, map, &mut out).unwrap(), CastLosses::default());
    std::mem::take(Codec::default().decode(Dtype::F64, &out))
}

fn close(found: &[f64], wanted: &[f64], within: f64) {
    assert_eq!(found.len(), wanted.len());
    for (found, wanted) in found.iter().zip(wanted) {
        assert!((found - wanted).abs() <= within, "{found} is not {wanted}");
    }
}

/// What a projector with the mapped weight and bias puts out is the mapped output of the old one.
#[test]
fn a_known_map_is_found_and_a_projector_follows_it() {
    let mut files = Files::default();
    let (map, matrix, shift) = embeddings(&mut files, 0.0);
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    // More columns than are mapped at a time.
    let columns = BLOCK + 3;
    let (weight, bias) = (normal(&mut rng, FROM * columns), normal(&mut rng, FROM));
    let of_weight = files.add("weight", &[FROM, columns], &weight);
    let of_bias = files.add("bias", &[FROM], &bias);
    let turned: Vec<f64> =
        (0..columns).flat_map(|c| (0..FROM).map(move |r| (r, c))).map(|(r, c)| weight[r * columns + c]).collect();
    let mapped = times(&matrix, FROM, &turned);
    let wanted: Vec<f64> =
        (0..TO).flat_map(|r| (0..columns).map(move |c| (r, c))).map(|(r, c)| 3.0 * mapped[c * TO + r]).collect();
    close(&written(&files, &of_weight, Mapped::Columns, 6.0, &map), &wanted, 1e-6);
    let half = |wanted: Vec<f64>| wanted.iter().map(|value| value * 0.5).collect::<Vec<_>>();
    let scaled: Vec<f64> = bias.iter().map(|value| value * 3.0).collect();
    let wanted: Vec<f64> = times(&matrix, FROM, &scaled).iter().zip(&shift).map(|(a, b)| a + b).collect();
    close(&written(&files, &of_bias, Mapped::Point, 3.0, &map), &half(wanted), 1e-6);
    let rows = normal(&mut rng, (BLOCK + 5) * FROM);
    let of_rows = files.add("rows", &[BLOCK + 5, FROM], &rows);
    let mut wanted = times(&matrix, FROM, &rows);
    for row in wanted.chunks_mut(TO) {
        row.iter_mut().zip(&shift).for_each(|(value, shift)| *value += shift);
    }
    close(&written(&files, &of_rows, Mapped::Rows, 1.0, &map), &half(wanted), 1e-6);
}

#[test]
fn words_that_were_left_out_are_predicted_unless_the_embeddings_have_nothing_in_common() {
    let predict = |noise: f64, mix: bool| {
        let mut files = Files::default();
        let (mut map, ..) = embeddings(&mut files, noise);
        map.ridge = 0.01;
        if mix {
            map.words.iter_mut().for_each(|[_, to]| *to = (*to * 67 + 5) % WORDS as u64);
        }
        let left_out = map.words.split_off(160);
        let mut read = files.read();
        let fitted = FittedMap::fit(&mut read, &map).unwrap();
        let (mut x, mut y) = (Vec::new(), Vec::new());
        EmbeddingRows::of(&map.from)
            .unwrap()
            .extend(&mut read, left_out.iter().map(|w| w[0]), &[0.0; FROM], &mut x)
            .unwrap();
        EmbeddingRows::of(&map.to)
            .unwrap()
            .extend(&mut read, left_out.iter().map(|w| w[1]), &[0.0; TO], &mut y)
            .unwrap();
        predicted(&fitted.points(&x, 1.0), &y, &fitted.to)
    };
    let near = predict(0.01, false);
    assert!(near.cosine > 0.99 && near.shuffled.abs() < 0.3, "{near:?}");
    assert!((near.size - 1.0).abs() < 0.05, "{near:?}");
    let far = predict(0.01, true);
    assert!(far.cosine.abs() < 0.3, "{far:?}");
}

#[test]
fn rows_that_determine_no_map_are_an_error() {
    let mut files = Files::default();
    let (mut map, ..) = embeddings(&mut files, 0.0);
    for value in [0.0, f64::NAN, f64::INFINITY] {
        map.from = files.add("from", &[WORDS, FROM], &[value; WORDS * FROM]);
        let error = FittedMap::fit(&mut files.read(), &map).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::InvalidData, "{value}");
    }
}

#[test]
fn maps_that_cannot_be_made_are_refused() {
    let mut files = Files::default();
    let (map, ..) = embeddings(&mut files, 0.0);
    assert_eq!(map.widths(), Ok([FROM as u64, TO as u64]));
    let refused = |change: fn(&mut WordMap<TensorRef>)| {
        let mut map = map.clone();
        change(&mut map);
        map.widths().unwrap_err()
    };
    let no_rows = "the embeddings do not have the rows of the words";
    assert_eq!(refused(|map| map.words.truncate(1)), no_rows);
    assert_eq!(refused(|map| map.words[3][1] = WORDS as u64), no_rows);
    assert_eq!(refused(|map| map.from.shape = vec![WORDS as u64]), "an embedding is no matrix");
    assert_eq!(refused(|map| map.ridge = 0.0), "0 is no penalty");
    assert_eq!(refused(|map| map.ridge = f64::NAN), "NaN is no penalty");
    assert_eq!(refused(|map| map.to.dtype = Dtype::I8), "values of type I8 can only be copied");
    assert_eq!(refused(|map| map.words = vec![[0, 0]; 16385]), "a map of 16385 words; at most 16384 are read");
    let mut many = map.clone();
    many.words = vec![[0, 0]; 16384];
    assert_eq!(many.widths(), Ok([FROM as u64, TO as u64]));
    // The matrices have at most 2^26 values.
    let wide = |width: u64| {
        let mut map = map.clone();
        map.from.shape[1] = 4096;
        map.to.shape[1] = width;
        map.widths()
    };
    assert_eq!(wide(8192), Ok([4096, 8192]));
    assert_eq!(wide(8193), Err("a map from 4096 to 8193 dimensions is too large".to_owned()));
}
