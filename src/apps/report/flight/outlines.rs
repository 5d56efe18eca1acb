//! Outlines of the areas that cells of a square grid form.

use std::{cmp::Reverse, collections::BTreeSet};

/// Column and row of a cell, or of the lower left corner of one.
pub type Place = [i32; 2];

/// Right, up, left, down.
const DIRECTIONS: [Place; 4] = [[1, 0], [0, 1], [-1, 0], [0, -1]];

/// Cells that are joined by their sides.
#[derive(Debug, PartialEq, Eq)]
pub struct Area {
    pub cells: usize,
    /// Closed rings of corners: the outline counterclockwise, then holes clockwise.
    pub rings: Vec<Vec<Place>>,
}

/// Joins cells to areas, the largest first.
pub fn areas(cells: impl IntoIterator<Item = Place>) -> Vec<Area> {
    let mut left: BTreeSet<Place> = cells.into_iter().collect();
    let mut areas = Vec::new();
    while let Some(first) = left.pop_first() {
        let (mut own, mut open) = (BTreeSet::from([first]), vec![first]);
        while let Some(cell) = open.pop() {
            for next in DIRECTIONS.map(|direction| beside(cell, direction)) {
                if left.remove(&next) {
                    own.insert(next);
                    open.push(next);
                }
            }
        }
        areas.push(Area {
            cells: own.len(),
            rings: rings(&own),
        });
    }
    // Stable: areas of one size stay in the order of their first cells.
    areas.sort_by_key(|area| Reverse(area.cells));
    areas
}

/// Walks along the sides between cells and others, with the cells on the left.
fn rings(cells: &BTreeSet<Place>) -> Vec<Vec<Place>> {
    let mut sides: BTreeSet<(Place, usize)> = BTreeSet::new();
    for &cell in cells {
        let [x, y] = cell;
        // The side that is walked to the right is the lower one, and so on around the cell.
        let corners = [[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]];
        for (direction, corner) in corners.into_iter().enumerate() {
            let outwards = DIRECTIONS[(direction + 3) % 4];
            if !cells.contains(&beside(cell, outwards)) {
                sides.insert((corner, direction));
            }
        }
    }
    let mut rings = Vec::new();
    // The first side of all, at the lower end of the left edge, is one of the outline.
    while let Some(&start) = sides.first() {
        let (mut ring, (mut at, mut direction)) = (vec![start.0], start);
        loop {
            sides.remove(&(at, direction));
            at = beside(at, DIRECTIONS[direction]);
            // Where four sides meet, a turn to the right goes round a hole that begins there: it
            // becomes a ring of its own, since none may touch itself.
            let turns = [3, 0, 1].map(|turn| (at, (direction + turn) % 4));
            let next = turns
                .into_iter()
                .find(|side| *side == start || sides.contains(side));
            if next.is_none_or(|side| side.1 != direction) {
                ring.push(at);
            }
            match next {
                Some(side) if side != start => direction = side.1,
                _ => break,
            }
        }
        rings.push(ring);
    }
    rings
}

fn beside([x, y]: Place, [right, up]: Place) -> Place {
    [x + right, y + up]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Twice the signed area that a ring encloses.
    fn doubled(ring: &[Place]) -> i32 {
        let cross = |side: &[Place]| side[0][0] * side[1][1] - side[1][0] * side[0][1];
        ring.windows(2).map(cross).sum()
    }

    #[test]
    fn an_area_has_its_corners_and_its_holes() {
        let ring_of_eight = (0..9).map(|i| [i % 3, i / 3]).filter(|at| *at != [1, 1]);
        let found = areas(ring_of_eight.chain([[7, 7]]));
        let of_eight = Area {
            cells: 8,
            rings: vec![
                vec![[0, 0], [3, 0], [3, 3], [0, 3], [0, 0]],
                vec![[1, 1], [1, 2], [2, 2], [2, 1], [1, 1]],
            ],
        };
        let of_one = vec![[7, 7], [8, 7], [8, 8], [7, 8], [7, 7]];
        assert_eq!(
            found,
            [
                of_eight,
                Area {
                    cells: 1,
                    rings: vec![of_one]
                }
            ]
        );
    }

    proptest! {
        #[test]
        fn rings_enclose_as_much_as_the_cells(
            cells in prop::collection::btree_set(prop::array::uniform2(0..7i32), 0..40)
        ) {
            let found = areas(cells.clone());
            prop_assert_eq!(found.iter().map(|area| area.cells).sum::<usize>(), cells.len());
            for Area { cells, rings } in found {
                prop_assert_eq!(rings.iter().map(|ring| doubled(ring)).sum::<i32>(), 2 * cells as i32);
                prop_assert!(doubled(&rings[0]) > 0);
                for ring in &rings {
                    prop_assert_eq!(ring.first(), ring.last());
                    let corners: BTreeSet<&Place> = ring.iter().collect();
                    prop_assert_eq!(corners.len(), ring.len() - 1);
                }
                for hole in &rings[1..] {
                    prop_assert!(doubled(hole) < 0);
                }
            }
        }
    }
}
