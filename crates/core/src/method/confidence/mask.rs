//! Masks of images.

/// Mask of an image by COLMAP's convention: black pixels must not be used.
#[derive(Clone, Debug, PartialEq)]
pub struct Mask {
    pub width: u32,
    pub height: u32,
    usable: Vec<bool>,
}

impl Mask {
    /// `usable`: one for each pixel, row by row; `None` if there are more or fewer.
    pub fn new(width: u32, height: u32, usable: Vec<bool>) -> Option<Self> {
        let pixels = width as usize * height as usize;
        (pixels > 0 && usable.len() == pixels).then_some(Self {
            width,
            height,
            usable,
        })
    }

    /// Returns whether the pixel at a position, given as shares of width and height, may be used.
    pub fn allows(&self, x: f64, y: f64) -> bool {
        let [column, row] = [(x, self.width), (y, self.height)].map(|(share, side)| {
            ((share * f64::from(side)).max(0.0) as usize).min(side as usize - 1)
        });
        self.usable[row * self.width as usize + column]
    }

    /// Returns the share of usable pixels in a cell of a grid that covers the image.
    pub fn share(&self, grid: [u32; 2], column: u32, row: u32) -> f32 {
        let (columns, rows) = (
            span(self.width, grid[0], column),
            span(self.height, grid[1], row),
        );
        let pixels = columns.len() * rows.len();
        let usable = rows.map(|y| {
            let line = &self.usable[y * self.width as usize..][columns.clone()];
            line.iter().filter(|u| **u).count()
        });
        usable.sum::<usize>() as f32 / pixels as f32
    }
}

/// Returns the pixels of a cell along one side, at least one: `cells` cells cover `length` pixels.
pub fn span(length: u32, cells: u32, cell: u32) -> std::ops::Range<usize> {
    let at = |i: u32| (u64::from(i) * u64::from(length) / u64::from(cells)) as usize;
    let from = at(cell).min(length as usize - 1);
    from..at(cell + 1).max(from + 1)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn the_cells_of_a_side_share_its_pixels(length in 1u32..500, cells in 1u32..100) {
            prop_assume!(cells <= length);
            let mut next = 0;
            for cell in 0..cells {
                let span = span(length, cells, cell);
                prop_assert_eq!(span.start, next);
                next = span.end;
            }
            prop_assert_eq!(next, length as usize);
        }
    }
}
