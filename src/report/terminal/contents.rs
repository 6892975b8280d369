//! The table of `--stats`.

use std::fmt::Write as _;

use super::load::table;
use crate::checkpoint::{TensorContents, TensorStats};
use crate::report::Style;
use crate::report::format::name;

/// A row for each tensor, however many there are: the user asked for them.
pub fn render(out: &mut String, contents: &[TensorContents], style: Style) {
    let rows: Vec<[String; 10]> =
        contents.iter().filter_map(|tensor| Some(row(tensor, tensor.stats.as_ref()?))).collect();
    if rows.is_empty() {
        return;
    }
    let header = ["tensor", "dtype", "min", "max", "mean", "rms", "zeros", "denormal", "NaN", "infinite"];
    table(out, header, &rows, Style { cap: usize::MAX, ..style });
    let _ok = writeln!(out);
}

fn row(tensor: &TensorContents, stats: &TensorStats) -> [String; 10] {
    let number = |n: Option<f64>| n.map_or_else(String::new, short);
    let share = |n: u64| share(n, tensor.elements);
    [
        name(&tensor.tensor),
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
    fn numbers_are_short() {
        let numbers = [0.0, -1.0, 0.020_004, 12.345_678, 1234.56, 1e-7, -65504.0, 3.4e38];
        let expected = ["0", "-1", "0.02", "12.346", "1234.6", "1.000e-7", "-65504", "3.400e38"];
        assert_eq!(numbers.map(short), expected);
        assert_eq!([share(0, 5), share(5, 5), share(1, 5), share(3, 100_000)], ["", "all", "20.0 %", "3"]);
    }
}
