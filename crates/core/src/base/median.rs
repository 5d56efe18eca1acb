//! Medians of numbers in any order.

/// Returns the median, for an even number of values the upper of the two in the middle: one of the
/// values. `None` without values.
pub fn upper_median(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.into_iter().collect();
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Returns the median, for an even number of values the mean of the two in the middle; `None`
/// without values.
pub fn median(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.into_iter().collect();
    let middle = values.len() / 2;
    if values.is_empty() {
        return None;
    }
    let is_even = values.len().is_multiple_of(2);
    let (below, &mut high, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    let low = below.iter().copied().max_by(f64::total_cmp);
    Some(0.5 * (low.filter(|_| is_even).unwrap_or(high) + high))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_an_even_number_one_is_the_upper_and_one_between() {
        assert_eq!(upper_median([4.0, 1.0, 3.0, 2.0]), Some(3.0));
        assert_eq!(median([4.0, 1.0, 3.0, 2.0]), Some(2.5));
        assert_eq!(median([4.0, 1.0, 3.0]), upper_median([3.0, 4.0, 1.0]));
        assert_eq!((median([]), upper_median([])), (None, None));
    }
}
