//! The table of `--stats`.

use std::fmt::Write as _;

use crate::checkpoint::{TensorContents, TensorStats};
use crate::report::format::name;

/// What the columns in front of the names contain.
const HEADER: [&str; 9] = ["dtype", "min", "max", "mean", "rms", "zeros", "denormal", "NaN", "infinite"];

/// A line for each tensor, however many there are: the user asked for them. Names are last, since they are of any length, and
/// columns without a value are left out.
pub fn render(out: &mut String, contents: &[TensorContents]) {
    let rows: Vec<([String; 9], String)> = contents
        .iter()
        .filter_map(|tensor| Some((row(tensor, tensor.stats.as_ref()?), name(&tensor.tensor))))
        .collect();
    if rows.is_empty() {
        return;
    }
    let header = (HEADER.map(str::to_owned), "tensor".to_owned());
    let lines = || std::iter::once(&header).chain(&rows);
    let mut widths = [0; 9];
    for (cells, _) in lines() {
        for (width, cell) in widths.iter_mut().zip(cells) {
            *width = cell.chars().count().max(*width);
        }
    }
    for (column, width) in widths.iter_mut().enumerate() {
        if rows.iter().all(|(cells, _)| cells.get(column).is_none_or(String::is_empty)) {
            *width = 0;
        }
    }
    for (cells, tensor) in lines() {
        let _ok = write!(out, " ");
        for (cell, width) in cells.iter().zip(widths).filter(|(_, width)| *width > 0) {
            let _ok = write!(out, " {cell:>width$} ");
        }
        let _ok = writeln!(out, " {tensor}");
    }
    let _ok = writeln!(out);
}

fn row(tensor: &TensorContents, stats: &TensorStats) -> [String; 9] {
    let number = |n: Option<f64>| n.map_or_else(String::new, short);
    let share = |n: u64| share(n, tensor.elements);
    [
        tensor.dtype.to_owned(),
        number(stats.min),
        if tensor.constant { "same".to_owned() } else { number(stats.max) },
        number(stats.mean),
        number(stats.rms),
        share(tensor.zeros),
        share(stats.denormals),
        share(tensor.nan),
        share(tensor.infinite),
    ]
}

/// Four digits, with an exponent where that is shorter.
fn short(number: f64) -> String {
    let size = number.abs();
    if number == 0.0 || (0.001..100_000.0).contains(&size) {
        let digits = if size >= 1000.0 {
            1
        } else if size >= 10.0 {
            3
        } else {
            4
        };
        let text = format!("{number:.digits$}");
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        format!("{number:.3e}")
    }
}

/// A share as a percentage; nothing for none.
fn share(n: u64, of: u64) -> String {
    #[expect(clippy::cast_precision_loss, reason = "a percentage")]
    let percent = n as f64 * 100.0 / of as f64;
    match n {
        0 => String::new(),
        _ if n == of => "all".to_owned(),
        _ if percent < 0.1 => n.to_string(),
        _ => format!("{percent:.1} %"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_any_length_are_last() {
        let tensor = |name: &str, min: f64, zeros: u64| TensorContents {
            file: "model.safetensors".to_owned(),
            tensor: name.to_owned(),
            dtype: "BF16",
            elements: 8,
            nan: 0,
            infinite: 1,
            zeros,
            constant: zeros == 7,
            stats: Some(TensorStats { min: Some(min), max: Some(0.0), mean: None, rms: Some(2.5e-9), denormals: 0 }),
        };
        let mut out = String::new();
        let long = format!("model.{}.weight", "x".repeat(80));
        render(&mut out, &[tensor(&long, -1.25, 2), tensor("b", 0.0, 7)]);
        let expected = "
  dtype    min   max       rms   zeros  infinite  tensor
   BF16  -1.25     0  2.500e-9  25.0 %    12.5 %  model.LONG.weight
   BF16      0  same  2.500e-9  87.5 %    12.5 %  b

";
        assert_eq!(format!("\n{}", out.replace(&"x".repeat(80), "LONG")), expected);
        out.clear();
        render(&mut out, &[TensorContents { stats: None, ..tensor("b", 0.0, 7) }]);
        assert_eq!(out, "");
    }

    #[test]
    fn numbers_are_short() {
        let numbers = [0.0, -1.0, 0.020_004, 12.345_678, 1234.56, 1e-7, -65504.0, 3.4e38];
        let expected = ["0", "-1", "0.02", "12.346", "1234.6", "1.000e-7", "-65504", "3.400e38"];
        assert_eq!(numbers.map(short), expected);
        assert_eq!([share(0, 5), share(5, 5), share(1, 5), share(3, 100_000)], ["", "all", "20.0 %", "3"]);
    }
}
