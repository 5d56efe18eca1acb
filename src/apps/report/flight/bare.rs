//! Images of the ground of a region that has no surface, because too few photographs show it: a
//! grid of views straight down, from the height that gives the wanted resolution.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Point3;

use super::{Waypoint, candidates};
use crate::{
    model::{camera::Camera, georeference::MapFrame},
    plan::Plan,
};

/// Most images that are planned; of more, those nearest to the photographs.
const MOST: usize = 2000;
/// Share of the region from which on ground without surface is worth a flight.
const WORTH_IT: f64 = 0.01;

/// The ground of a region that has no surface and that too few photographs show.
#[derive(Clone, Debug, PartialEq)]
pub struct BareGround {
    /// Square scene units.
    pub area: f64,
    /// A place on it, world coordinates.
    pub centre: Point3<f64>,
    /// Images over it, row by row.
    pub waypoints: Vec<Waypoint>,
    /// Part of its area below them, 0 to 1: less than 1 where more than the most would be needed.
    pub covered: f64,
}

/// A square of the grid of images: column and row.
type Square = [i64; 2];

/// Plans the images; `None` without a region, or without such ground. `needed`: cameras that must
/// see a place; `hole`: index of the ground among the listed holes.
pub fn bare_ground(plan: &Plan, frame: &MapFrame, needed: u32, hole: usize) -> Option<BareGround> {
    let stages = &plan.stages;
    let ground = stages.ground.as_ref()?;
    let bare: Vec<[f64; 2]> = ground
        .cells
        .iter()
        .filter(|cell| !cell.has_surface && cell.views < needed)
        .map(|cell| cell.place)
        .collect();
    if (bare.len() as f64) < WORTH_IT * ground.cells.len() as f64 {
        return None;
    }
    let camera = candidates::usual_camera(plan)?;
    let camera = &stages.scene.cameras[camera.index()];
    let gsd = stages.settings.target.gsd?;
    let distance = candidates::distance(plan, gsd, camera);
    let step = candidates::step(distance);
    let square = |[x, y]: [f64; 2]| -> Square { [x, y].map(|at| (at / step).floor() as i64) };
    // One more on each side: at the rim, too, a place is seen from several.
    let mut squares: BTreeSet<Square> = BTreeSet::new();
    for place in &bare {
        squares.extend(around(square(*place)));
    }
    let middle = |[column, row]: Square| [column, row].map(|at| (at as f64 + 0.5) * step);
    let chosen = nearest_to(&flown(plan, frame), squares, middle);
    let heights = heights(plan, frame, &chosen, square);
    let up = ground.plane.up();
    let waypoint = |(n, square): (usize, &Square)| {
        let below = ground.plane.at(middle(*square));
        let rise = heights
            .get(square)
            .map_or(0.0, |height| (height - frame.local(&below)[2]).max(0.0));
        Waypoint {
            rank: n + 1,
            centre: below + up * (distance + rise),
            direction: -up,
            hole,
            height: distance + rise,
            distance: distance + rise,
            overlap: overlap(camera, distance + rise, step),
        }
    };
    let below = |place: &&[f64; 2]| chosen.contains(&square(**place));
    let covered = bare.iter().filter(below).count() as f64 / bare.len() as f64;
    Some(BareGround {
        area: bare.len() as f64 * ground.side * ground.side,
        centre: ground.plane.at(typical(&bare)),
        waypoints: row_by_row(&chosen)
            .iter()
            .enumerate()
            .map(waypoint)
            .collect(),
        covered,
    })
}

/// Positions of the photographs on the map.
fn flown(plan: &Plan, frame: &MapFrame) -> Vec<[f64; 2]> {
    let centres = plan.stages.scene.views.iter();
    let flat = centres.map(|view| frame.local(&view.cam_from_world.centre()));
    flat.map(|[x, y, _]| [x, y]).collect()
}

/// The squares whose middles are nearest to some positions, [`MOST`] at most.
fn nearest_to(
    positions: &[[f64; 2]],
    squares: BTreeSet<Square>,
    middle: impl Fn(Square) -> [f64; 2],
) -> BTreeSet<Square> {
    if squares.len() <= MOST {
        return squares;
    }
    let distance = |square: &Square| {
        let [x, y] = middle(*square);
        let to = |[px, py]: &[f64; 2]| (px - x).hypot(py - y);
        positions.iter().map(to).fold(f64::INFINITY, f64::min)
    };
    let mut by_distance: Vec<(f64, Square)> = squares
        .iter()
        .map(|square| (distance(square), *square))
        .collect();
    by_distance.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let nearest = by_distance.into_iter().take(MOST);
    nearest.map(|(_, square)| square).collect()
}

/// Height of the highest vertex of the surface in or beside each square, where there is one.
fn heights(
    plan: &Plan,
    frame: &MapFrame,
    squares: &BTreeSet<Square>,
    square: impl Fn([f64; 2]) -> Square,
) -> BTreeMap<Square, f64> {
    let mut heights: BTreeMap<Square, f64> = BTreeMap::new();
    for vertex in &plan.stages.surface.vertices {
        let [x, y, z] = frame.local(vertex);
        for beside in around(square([x, y])).filter(|beside| squares.contains(beside)) {
            let height = heights.entry(beside).or_insert(z);
            *height = height.max(z);
        }
    }
    heights
}

/// A square and the eight beside it.
fn around([column, row]: Square) -> impl Iterator<Item = Square> {
    (-1..=1).flat_map(move |x| (-1..=1).map(move |y| [column + x, row + y]))
}

/// The squares in rows, every other one backwards.
fn row_by_row(squares: &BTreeSet<Square>) -> Vec<Square> {
    let mut ordered: Vec<Square> = squares.iter().copied().collect();
    ordered.sort_by_key(|&[column, row]| match row.rem_euclid(2) {
        0 => (row, column),
        _ => (row, -column),
    });
    ordered
}

/// Share of what an image shows that the next one shows, too.
fn overlap(camera: &Camera, distance: f64, step: f64) -> f64 {
    let (focal, _) = camera.pinhole_part();
    let shown = (distance / focal.x * f64::from(camera.width))
        .min(distance / focal.y * f64::from(camera.height));
    (1.0 - step / shown).max(0.0)
}

/// The place nearest to the mean of some, which is one of them.
fn typical(places: &[[f64; 2]]) -> [f64; 2] {
    let count = places.len() as f64;
    let mean = [0, 1].map(|axis| places.iter().map(|place| place[axis]).sum::<f64>() / count);
    let off = |place: &&[f64; 2]| (place[0] - mean[0]).hypot(place[1] - mean[1]);
    let nearest = places.iter().min_by(|a, b| off(a).total_cmp(&off(b)));
    nearest.copied().unwrap_or(mean)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_flown_there_and_back() {
        let squares: BTreeSet<Square> = [[0, 0], [1, 0], [0, 1], [1, 1], [0, -1]].into();
        assert_eq!(
            row_by_row(&squares),
            [[0, -1], [0, 0], [1, 0], [1, 1], [0, 1]]
        );
    }

    #[test]
    fn of_too_many_squares_the_nearest_stay() {
        let squares: BTreeSet<Square> = (0..MOST as i64 + 10).map(|column| [column, 0]).collect();
        let middle = |[column, row]: Square| [column as f64, row as f64];
        let kept = nearest_to(&[[5.0, 0.0]], squares.clone(), middle);
        assert_eq!(kept.len(), MOST);
        assert_eq!(kept.last(), Some(&[MOST as i64 - 1, 0]));
        let few: BTreeSet<Square> = squares.into_iter().take(3).collect();
        assert_eq!(nearest_to(&[], few.clone(), middle), few);
    }
}
