//! Numbers for people and files, with as many digits as are of use.

/// Rounds to a number of decimals; never to -0.
pub fn to_decimals(number: f64, decimals: i32) -> f64 {
    let scale = 10f64.powi(decimals);
    // Adding 0 turns -0 into 0.
    (number * scale).round() / scale + 0.0
}

/// Formats a number with three significant digits.
pub fn significant(number: f64) -> String {
    if number == 0.0 {
        return "0".into();
    }
    if !number.is_finite() {
        return number.to_string();
    }
    let places = (2 - number.abs().log10().floor() as i32).max(0) as usize;
    format!("{number:.places$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_rounded_to_minus_nothing() {
        for (number, text) in [(-0.04, "0.0"), (-0.06, "-0.1"), (-0.0, "0.0")] {
            assert_eq!(format!("{:.1}", to_decimals(number, 1)), text);
        }
    }

    #[test]
    fn three_digits_are_kept() {
        assert_eq!(
            [0.0123456, 1.0, 12345.6, 0.5].map(significant),
            ["0.0123", "1.00", "12346", "0.500"]
        );
    }
}
