//! Words for the area that a share is of.

/// The area that shares of depth maps are of. `all`: those that the project can have, where that is
/// known; `has_region`: only what is inside a region counts.
pub fn area_of_all(all: Option<usize>, has_region: bool) -> String {
    let all = all.map_or_else(String::new, |all| format!(" {}", grouped(all)));
    let inside = if has_region { " inside the region" } else { "" };
    format!("the area that all{all} cover{inside}")
}

/// Formats an integer as "12,345".
pub fn grouped(number: usize) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_area_is_that_of_all_depth_maps_inside_the_region() {
        let area = area_of_all(Some(1234), true);
        assert_eq!(area, "the area that all 1,234 cover inside the region");
        assert_eq!(area_of_all(None, false), "the area that all cover");
    }
}
