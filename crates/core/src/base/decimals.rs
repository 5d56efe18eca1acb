//! Numbers for people and files, with a fixed number of decimals.

/// Rounds to the number of decimals that is of use; never to -0.
pub fn to_decimals(number: f64, decimals: i32) -> f64 {
    let scale = 10f64.powi(decimals);
    (number * scale).round() / scale + 0.0
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
}
