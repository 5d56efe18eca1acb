//! Images of bare ground of a region, which has no surface because too few photographs show it, or
//! one that all of them show too coarsely: a grid of views straight down, from the height that
//! gives the wanted resolution.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet, BinaryHeap},
};

use nalgebra::Point3;
use rayon::prelude::*;

use super::{Site, Waypoint, candidates};
use crate::{
    base::{kd_tree::KdTree, median::upper_median},
    method::region::{Ground, GroundCell, GroundPlane},
    model::{
        camera::Camera,
        georeference::MapFrame,
        scene::{CameraIndex, Scene, ViewIndex},
    },
};

/// Most images that are planned; of more, those nearest to the photographs.
pub const MOST: usize = 2000;
/// Most places that images are planned over before the nearest are taken.
const MOST_PLACES: usize = 100_000;
/// Share of the region from which on bare ground is worth a flight.
const WORTH_IT: f64 = 0.01;
/// The ground's place among the listed holes.
const GROUND: usize = 0;
/// Number of the outermost squares.
const FARTHEST: f64 = 1e15;
/// Distance of a photograph, over that of a planned image, up to which the two can be matched.
const COARSER: f64 = 3.0;
/// Samples along a side of what a planned image shows.
const SAMPLES: usize = 8;
/// Distance, over that which gives the wanted resolution, up to which a planned image shows a
/// place.
const FARTHER: f64 = 1.5;

/// The ground of a region that too few photographs show finely enough for a surface.
#[derive(Clone, Debug, PartialEq)]
pub struct BareGround {
    /// Square scene units.
    pub area: f64,
    /// A place on it, world coordinates.
    pub centre: Point3<f64>,
    /// Images over it, row by row.
    pub waypoints: Vec<Waypoint>,
    /// Part of its area below them and those for other holes, 0 to 1: less than 1 where more than
    /// the most would be needed.
    pub covered: f64,
    /// About how many more would be needed for all of it, beyond the most that are planned.
    pub more: usize,
    /// Usual distance between neighbours on a line, and between lines, scene units; of images from
    /// several heights those that are lowest. `None` for a single line.
    pub spacing: Option<[f64; 2]>,
}

impl BareGround {
    /// The shortage, in words.
    pub fn missing(&self, needed: u32) -> String {
        format!("bare ground: fewer photographs show it finely enough than the {needed} needed")
    }
}

/// A square of the grid of images: column and row.
type Square = [i64; 2];

/// A place that too few images show.
#[derive(Clone, Copy)]
struct Lack {
    /// On the map.
    place: [f64; 2],
    /// Images that it needs besides those taken and planned.
    images: u32,
}

/// Images straight down from the distance of the wanted resolution, one over each square.
struct Overhead<'a> {
    camera: &'a Camera,
    /// From the ground, scene units.
    distance: f64,
    /// Side of a square, scene units.
    step: f64,
}

/// Plans the images; `None` without such ground. `needed`: cameras that must
/// see a place; `planned`: images for the other holes, which show some of it.
pub fn bare_ground(
    site: &Site,
    ground: &Ground,
    frame: &MapFrame,
    needed: u32,
    planned: &[Waypoint],
) -> Option<BareGround> {
    let camera = candidates::usual_camera(site.scene)?;
    let is_bare = |cell: &&GroundCell| is_bare(cell, needed);
    let bare: Vec<GroundCell> = ground.cells.iter().filter(is_bare).copied().collect();
    if (bare.len() as f64) < WORTH_IT * ground.cells.len() as f64 {
        return None;
    }
    let flown = Flown::new(site.scene, frame);
    // The finest first: its images show some of what the others want.
    let mut all = planned.to_vec();
    let (mut uncovered, mut more, mut spacing) = (0.0, 0, None);
    for cells in by_resolution(&bare) {
        let images = Overhead::new(site, camera, cells[0].gsd);
        // What the images until now leave.
        let left = images.lacking(ground, cells, needed, &all);
        let first = all.len() - planned.len();
        let part = images.part(&left, ground.side, &flown, MOST - first);
        let waypoints = images.waypoints(site, ground, frame, &part.chosen);
        spacing = spacing.or_else(|| images.spacing(&part.chosen));
        all.extend(waypoints.into_iter().map(|waypoint| Waypoint {
            rank: first + waypoint.rank,
            ..waypoint
        }));
        uncovered += part.uncovered;
        more += part.more;
    }
    Some(BareGround {
        area: bare.len() as f64 * ground.side * ground.side,
        centre: ground.plane.at(typical(&bare)),
        waypoints: all.split_off(planned.len()),
        covered: 1.0 - uncovered / bare.len() as f64,
        more,
        spacing,
    })
}

/// Returns whether fewer cameras show a cell than needed, and its surface, if any, is shown too
/// coarsely by all of them: what else the surface lacks is one of its holes.
fn is_bare(cell: &GroundCell, needed: u32) -> bool {
    (!cell.has_surface || cell.too_coarse) && cell.views < needed
}

/// Groups cells whose images are taken from one height, the finest first, which sets it.
fn by_resolution(cells: &[GroundCell]) -> Vec<Vec<GroundCell>> {
    let mut sorted = cells.to_vec();
    // A stable sort: ties stay row by row.
    sorted.sort_by(|a, b| a.gsd.total_cmp(&b.gsd));
    let mut groups: Vec<Vec<GroundCell>> = Vec::new();
    for cell in sorted {
        match groups.last_mut() {
            Some(group) if cell.gsd <= FARTHER * group[0].gsd => group.push(cell),
            _ => groups.push(vec![cell]),
        }
    }
    groups
}

/// Images over the cells that want about the same resolution.
struct Part {
    chosen: BTreeSet<Square>,
    /// Cells that still lack some.
    uncovered: f64,
    /// As [`BareGround::more`].
    more: usize,
}

impl<'a> Overhead<'a> {
    fn new(site: &Site<'a>, camera: CameraIndex, gsd: f64) -> Self {
        let camera = &site.scene.cameras[camera.index()];
        let distance = candidates::distance(site.image_scale, gsd, camera);
        Self {
            camera,
            distance,
            step: candidates::step(distance),
        }
    }

    /// Chooses images for cells of a side; `most`: that may be taken.
    fn part(&self, left: &[Lack], side: f64, flown: &Flown, most: usize) -> Part {
        let (places, each) = divided(left, side, self.step, flown);
        // One more on each side: at the rim, too, a place is seen from several.
        let squares = places
            .iter()
            .flat_map(|lack| around(self.square(lack.place)));
        let squares: BTreeSet<Square> = squares.collect();
        let number = squares.len();
        let are_too_many = number > most;
        let chosen = if are_too_many {
            self.nearest_to(flown, squares, most)
        } else {
            self.enough(&places, &squares)
        };
        let covered = self.shown_often_enough(&places, &chosen) as f64 / each as f64;
        let uncovered = left.len() as f64 - covered;
        let more = match chosen.len() {
            _ if !are_too_many => 0,
            0 => number,
            // In proportion to the area.
            n => (n as f64 * uncovered / covered.max(1.0)).ceil() as usize,
        };
        Part {
            chosen,
            uncovered,
            more,
        }
    }

    fn square(&self, place: [f64; 2]) -> Square {
        // A stranger's area may want a resolution that no number of images gives.
        place.map(|at| (at / self.step).floor().clamp(-FARTHEST, FARTHEST) as i64)
    }

    fn middle(&self, square: Square) -> [f64; 2] {
        square.map(|at| (at as f64 + 0.5) * self.step)
    }

    /// Returns whether the image over a square shows a place.
    fn shows(&self, square: Square, place: [f64; 2]) -> bool {
        let (middle, reach) = (self.middle(square), 0.5 * shown(self.camera, self.distance));
        (0..2).all(|axis| (middle[axis] - place[axis]).abs() <= reach)
    }

    /// Returns the bare cells that still lack images, with those planned.
    fn lacking(
        &self,
        ground: &Ground,
        cells: Vec<GroundCell>,
        needed: u32,
        planned: &[Waypoint],
    ) -> Vec<Lack> {
        let lacking = |cell: GroundCell| {
            let place = ground.plane.at(cell.place);
            let shows = |waypoint: &&Waypoint| self.is_shown_by(waypoint, &place);
            let images = cell.views + planned.iter().filter(shows).count() as u32;
            (images < needed).then(|| Lack {
                place: cell.place,
                images: needed - images,
            })
        };
        cells.into_iter().filter_map(lacking).collect()
    }

    /// Returns whether an image planned for a hole shows a place about as finely; of its frame, the
    /// circle inside counts.
    fn is_shown_by(&self, waypoint: &Waypoint, place: &Point3<f64>) -> bool {
        let ray = place - waypoint.centre;
        let reach = 0.5 * shown(self.camera, 1.0);
        let along = ray.dot(&waypoint.direction);
        let across = (ray - waypoint.direction * along).norm();
        (0.0..=FARTHER * self.distance).contains(&along) && across <= reach * along
    }

    /// Returns the number of places that get all the images that they lack.
    fn shown_often_enough(&self, places: &[Lack], chosen: &BTreeSet<Square>) -> usize {
        let is_shown = |lack: &&Lack| {
            let shows = |square: &&Square| self.shows(**square, lack.place);
            let images = lack.images as usize;
            chosen.iter().filter(shows).take(images).count() == images
        };
        places.iter().filter(is_shown).count()
    }

    /// Returns the usual distance between neighbours in a row, and between rows.
    fn spacing(&self, chosen: &BTreeSet<Square>) -> Option<[f64; 2]> {
        let mut rows: BTreeMap<i64, Vec<i64>> = BTreeMap::new();
        for &[column, row] in chosen {
            rows.entry(row).or_default().push(column);
        }
        let along = rows.values().flat_map(|columns| gaps(columns));
        let numbers: Vec<i64> = rows.keys().copied().collect();
        let [along, between] = [upper_median(along)?, upper_median(gaps(&numbers))?];
        Some([along * self.step, between * self.step])
    }

    /// Returns the images over these squares, row by row, at the planned distance above the highest
    /// surface nearby; without any, above the fitted plane.
    fn waypoints(
        &self,
        site: &Site,
        ground: &Ground,
        frame: &MapFrame,
        chosen: &BTreeSet<Square>,
    ) -> Vec<Waypoint> {
        let heights = self.heights(site.surface, frame, chosen);
        let up = ground.plane.up();
        let waypoint = |(n, square): (usize, &Square)| {
            let on_plane = ground.plane.at(self.middle(*square));
            let rise = heights.get(square);
            let rise = rise.map_or(0.0, |height| height - frame.local(&on_plane)[2]);
            let [lower, distance] = self.over(rise);
            let below = on_plane - up * lower;
            let planned = self.overlap(*square, chosen, distance);
            let flown = self.overlap_with_photographs(site.scene, &ground.plane, *square, distance);
            Waypoint {
                rank: n + 1,
                centre: below + up * distance,
                direction: -up,
                hole: GROUND,
                height: distance,
                distance,
                overlap: planned.max(flown),
            }
        };
        row_by_row(chosen)
            .par_iter()
            .enumerate()
            .map(waypoint)
            .collect()
    }

    /// Returns how far the ground is below the plane, and the distance of an image from it. `rise`:
    /// that of the highest surface nearby above the plane: where it is below, so is the ground.
    fn over(&self, rise: f64) -> [f64; 2] {
        [(-rise).max(0.0), self.distance + rise.max(0.0)]
    }

    /// Returns the largest share of what the image over a square shows, from a distance, that one
    /// other of these shows, too.
    fn overlap(&self, square: Square, chosen: &BTreeSet<Square>, distance: f64) -> f64 {
        let side = shown(self.camera, distance);
        let with = |other: &Square| -> f64 {
            let apart = |axis: usize| self.step * (other[axis] - square[axis]).abs() as f64;
            (0..2)
                .map(|axis| (1.0 - apart(axis) / side).max(0.0))
                .product()
        };
        let others = chosen.iter().filter(|other| **other != square);
        others.map(with).fold(0.0, f64::max)
    }

    /// As [`Self::overlap`], with one photograph from at most [`COARSER`] times the distance; by
    /// samples on the plane.
    fn overlap_with_photographs(
        &self,
        scene: &Scene,
        plane: &GroundPlane,
        square: Square,
        distance: f64,
    ) -> f64 {
        let side = shown(self.camera, distance);
        let along = |i: usize| ((i as f64 + 0.5) / SAMPLES as f64 - 0.5) * side;
        let [x, y] = self.middle(square);
        let sample = |i| plane.at([x + along(i % SAMPLES), y + along(i / SAMPLES)]);
        let samples: Vec<Point3<f64>> = (0..SAMPLES * SAMPLES).map(sample).collect();
        let middle = plane.at([x, y]);
        let shown_by = |view: ViewIndex| {
            let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
            // Measured from the middle: a side more, for photographs above the rim.
            if (pose.centre() - middle).norm() > COARSER * distance + side {
                return 0;
            }
            let shows = |place: &&Point3<f64>| {
                let pixel = camera.project(&pose.camera_from_world(place));
                pixel.is_some_and(|pixel| camera.contains(&pixel))
            };
            samples.iter().filter(shows).count()
        };
        let most = scene.view_indices().map(shown_by).max().unwrap_or(0);
        most as f64 / samples.len() as f64
    }

    /// Chooses images until each place is shown by as many as it lacks, those first that show most
    /// such places.
    fn enough(&self, places: &[Lack], squares: &BTreeSet<Square>) -> BTreeSet<Square> {
        let squares: Vec<Square> = squares.iter().copied().collect();
        let below = |square: &Square| -> Vec<u32> {
            let places = (0..).zip(places);
            let below = places.filter(|(_, lack)| self.shows(*square, lack.place));
            below.map(|(i, _)| i).collect()
        };
        let below: Vec<Vec<u32>> = squares.par_iter().map(below).collect();
        let mut lacking: Vec<u32> = places.iter().map(|lack| lack.images).collect();
        // Gains only fall: what is at the top with a gain of now is best.
        let known = below
            .iter()
            .map(Vec::len)
            .zip((0..squares.len()).map(Reverse));
        let mut by_gain: BinaryHeap<(usize, Reverse<usize>)> = known.collect();
        let mut chosen = BTreeSet::new();
        while let Some((known, Reverse(next))) = by_gain.pop() {
            let lack = |&&place: &&u32| lacking[place as usize] > 0;
            let gain = below[next].iter().filter(lack).count();
            if gain < known {
                by_gain.push((gain, Reverse(next)));
                continue;
            }
            if gain == 0 {
                break;
            }
            chosen.insert(squares[next]);
            for &place in &below[next] {
                // The image may also show places that have enough.
                lacking[place as usize] = lacking[place as usize].saturating_sub(1);
            }
        }
        chosen
    }

    /// The squares whose middles are nearest to the photographs, `most` of them.
    fn nearest_to(
        &self,
        flown: &Flown,
        squares: BTreeSet<Square>,
        most: usize,
    ) -> BTreeSet<Square> {
        let mut by_distance: Vec<(f64, Square)> = squares
            .iter()
            .map(|square| (flown.distance(self.middle(*square)), *square))
            .collect();
        by_distance.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let nearest = by_distance.into_iter().take(most);
        nearest.map(|(_, square)| square).collect()
    }

    /// Height of the highest vertex of the surface in or beside each square, where there is one.
    fn heights(
        &self,
        surface: &[Point3<f64>],
        frame: &MapFrame,
        squares: &BTreeSet<Square>,
    ) -> BTreeMap<Square, f64> {
        let mut heights: BTreeMap<Square, f64> = BTreeMap::new();
        for vertex in surface {
            let [x, y, z] = frame.local(vertex);
            for beside in around(self.square([x, y])).filter(|beside| squares.contains(beside)) {
                let height = heights.entry(beside).or_insert(z);
                *height = height.max(z);
            }
        }
        heights
    }
}

/// Divides cells into places no farther apart than the images, as many in each; returns them and
/// their number in a cell. Of more than [`MOST_PLACES`], those in the cells nearest to the
/// photographs.
fn divided(cells: &[Lack], side: f64, step: f64, flown: &Flown) -> (Vec<Lack>, usize) {
    let most = (MOST_PLACES as f64).sqrt();
    let along = (side / step).ceil().clamp(1.0, most) as usize;
    let each = along * along;
    let mut nearest = cells.to_vec();
    if cells.len() * each > MOST_PLACES {
        let mut by_distance: Vec<(f64, Lack)> = nearest
            .into_iter()
            .map(|cell| (flown.distance(cell.place), cell))
            .collect();
        // A stable sort: ties stay row by row.
        by_distance.sort_by(|a, b| a.0.total_cmp(&b.0));
        by_distance.truncate(MOST_PLACES.div_ceil(each));
        nearest = by_distance.into_iter().map(|(_, cell)| cell).collect();
    }
    let part = side / along as f64;
    let places = |cell: Lack| {
        let offset = move |i: usize| (i as f64 + 0.5) * part - 0.5 * side;
        let [x, y] = cell.place;
        (0..each).map(move |i| Lack {
            place: [x + offset(i % along), y + offset(i / along)],
            ..cell
        })
    };
    (nearest.into_iter().flat_map(places).collect(), each)
}

/// Positions of the photographs on the map.
struct Flown {
    positions: Vec<Point3<f64>>,
    tree: KdTree,
}

impl Flown {
    fn new(scene: &Scene, frame: &MapFrame) -> Self {
        let centres = scene.views.iter();
        let flat = centres.map(|view| frame.local(&view.cam_from_world.centre()));
        Self::at(flat.map(|[x, y, _]| [x, y]))
    }

    fn at(positions: impl Iterator<Item = [f64; 2]>) -> Self {
        let positions: Vec<Point3<f64>> = positions.map(|[x, y]| Point3::new(x, y, 0.0)).collect();
        Self {
            tree: KdTree::new(&positions),
            positions,
        }
    }

    /// Distance of a place from the nearest; infinite without any.
    fn distance(&self, [x, y]: [f64; 2]) -> f64 {
        if self.positions.is_empty() {
            return f64::INFINITY;
        }
        let place = Point3::new(x, y, 0.0);
        let [nearest] = self.tree.nearest::<1>(&place);
        (self.positions[nearest as usize] - place).norm()
    }
}

/// The differences of ascending numbers.
fn gaps(numbers: &[i64]) -> impl Iterator<Item = f64> + '_ {
    numbers.windows(2).map(|pair| (pair[1] - pair[0]) as f64)
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

/// The shorter side of what an image shows from a distance.
fn shown(camera: &Camera, distance: f64) -> f64 {
    let (focal, _) = camera.pinhole_part();
    (distance / focal.x * f64::from(camera.width))
        .min(distance / focal.y * f64::from(camera.height))
}

/// The place nearest to the mean of some, which is one of them.
fn typical(cells: &[GroundCell]) -> [f64; 2] {
    let count = cells.len() as f64;
    let sum = |axis: usize| cells.iter().map(|cell| cell.place[axis]).sum::<f64>();
    let mean = [0, 1].map(|axis| sum(axis) / count);
    let off = |place: &[f64; 2]| (place[0] - mean[0]).hypot(place[1] - mean[1]);
    let places = cells.iter().map(|cell| cell.place);
    // The mean of a ring of cells is on none of them.
    let nearest = places.min_by(|a, b| off(a).total_cmp(&off(b)));
    nearest.unwrap_or(mean)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Rotation3};

    use super::*;
    use crate::model::{
        camera::CameraModel,
        scene::{Pose, View},
    };

    /// A camera that shows 10 by 10 units from the distance, and squares of the given side.
    fn overhead(camera: &Camera, step: f64) -> Overhead<'_> {
        Overhead {
            camera,
            distance: 10.0,
            step,
        }
    }

    fn camera() -> Camera {
        let params = vec![100.0, 100.0, 50.0, 50.0];
        Camera::new(1, CameraModel::Pinhole, 100, 100, params).unwrap()
    }

    fn lack(x: f64, images: u32) -> Lack {
        let place = [x, 0.0];
        Lack { place, images }
    }

    #[test]
    fn each_area_is_flown_at_about_the_resolution_that_it_wants() {
        let cell = |n: u32, gsd: f64| GroundCell {
            place: [f64::from(n), 0.0],
            gsd,
            views: 0,
            too_coarse: false,
            has_surface: false,
        };
        let cells = [7.0, 2.0, 2.9, 7.0, 2.0].into_iter().zip(0..);
        let cells: Vec<GroundCell> = cells.map(|(gsd, n)| cell(n, gsd)).collect();
        let groups = by_resolution(&cells);
        let groups: Vec<Vec<f64>> = groups
            .iter()
            .map(|group| group.iter().map(|cell| cell.place[0]).collect())
            .collect();
        assert_eq!(groups, [vec![1.0, 4.0, 2.0], vec![0.0, 3.0]]);
    }

    #[test]
    fn rows_are_flown_there_and_back() {
        let squares: BTreeSet<Square> = [[0, 0], [1, 0], [0, 1], [1, 1], [0, -1]].into();
        assert_eq!(
            row_by_row(&squares),
            [[0, -1], [0, 0], [1, 0], [1, 1], [0, 1]]
        );
    }

    #[test]
    fn large_cells_are_covered_without_gaps() {
        let cells = [lack(0.0, 3), lack(47.0, 3)];
        let (places, each) = divided(&cells, 47.0, 12.5, &Flown::at([].into_iter()));
        assert_eq!((places.len(), each), (32, 16));
        let square = |at: f64| (at / 12.5).floor() as i64;
        let columns: BTreeSet<i64> = places.iter().map(|lack| square(lack.place[0])).collect();
        assert!(columns.into_iter().eq(square(-23.5)..=square(70.4)));
        let cells: Vec<Lack> = (0..1000).map(|n| lack(f64::from(n) * 50.0, 1)).collect();
        let (places, each) = divided(&cells, 50.0, 1.0, &Flown::at([[0.0, 0.0]].into_iter()));
        assert_eq!((places.len(), each), (MOST_PLACES, 2500));
        assert!(places.iter().all(|lack| lack.place[0] < 40.0 * 50.0));
    }

    #[test]
    fn images_are_chosen_until_each_place_is_shown_often_enough() {
        let places: Vec<Lack> = (0..20)
            .map(|n| lack(f64::from(n), if n < 10 { 1 } else { 3 }))
            .collect();
        let squares: BTreeSet<Square> = (-3..13).flat_map(|x| [[x, -1], [x, 0], [x, 1]]).collect();
        let camera = camera();
        let images = overhead(&camera, 2.0);
        let chosen = images.enough(&places, &squares);
        for lack in &places {
            let shows = |square: &&Square| images.shows(**square, lack.place);
            let shown = chosen.iter().filter(shows).count() as u32;
            assert!(shown >= lack.images, "{:?}", lack.place);
        }
        assert_eq!(images.shown_often_enough(&places, &chosen), places.len());
        assert!(chosen.len() <= 5, "{chosen:?}");
    }

    #[test]
    fn the_overlap_is_that_with_the_image_that_shows_most_of_the_same() {
        let camera = camera();
        let images = overhead(&camera, 2.0);
        let chosen: BTreeSet<Square> = [[0, 0], [2, 0], [2, 1], [40, 40]].into();
        let overlaps = chosen.iter().map(|of| images.overlap(*of, &chosen, 10.0));
        assert!(overlaps.eq([0.6, 0.8, 0.8, 0.0]));
    }

    #[test]
    fn the_overlap_with_a_photograph_is_that_of_what_they_show() {
        let camera = camera();
        let images = overhead(&camera, 2.0);
        let frame = MapFrame::new(&Scene::default(), Some([0.0, 0.0, 1.0]));
        let corners = [[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]];
        let corners = corners.map(|[x, y]| Point3::new(x, y, 0.0));
        let plane = GroundPlane::new(&frame, &corners).unwrap();
        let east = (plane.at([1.0, 0.0]) - plane.at([0.0, 0.0])).normalize();
        let down = -plane.up();
        let axes = [east, down.cross(&east), down].map(|axis| axis.transpose());
        let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_rows(&axes));
        let [x, y] = images.middle([0, 0]);
        let photograph = |along: f64, height: f64| View {
            name: "flown".into(),
            image_id: 1,
            file_position: 0,
            camera: CameraIndex(0),
            cam_from_world: Pose {
                rotation,
                translation: -(rotation * (plane.at([x + along, y]) - down * height).coords),
            },
        };
        let overlap = |along, height| {
            let scene = Scene {
                cameras: vec![camera.clone()],
                views: vec![photograph(along, height)],
                ..Scene::default()
            };
            images.overlap_with_photographs(&scene, &plane, [0, 0], 10.0)
        };
        assert_eq!(overlap(0.0, 10.0), 1.0);
        assert_eq!(overlap(5.0, 10.0), 0.5);
        assert_eq!(overlap(10.0, 10.0), 0.0);
        // From half the height it shows a quarter; what it shows from far above is too coarse.
        assert_eq!(overlap(0.0, 5.0), 0.25);
        assert_eq!(overlap(0.0, 100.0), 0.0);
    }

    #[test]
    fn the_highest_surface_is_seen_at_the_wanted_resolution_also_below_the_plane() {
        let camera = camera();
        let images = overhead(&camera, 2.0);
        for rise in [-30.0, -2.0, 0.0, 3.0] {
            let [lower, distance] = images.over(rise);
            assert_eq!(distance - lower - rise, images.distance);
            assert!(lower >= 0.0 && distance >= images.distance);
        }
    }

    #[test]
    fn the_spacing_is_that_of_most_images() {
        let camera = camera();
        let images = overhead(&camera, 2.0);
        let row = |y: i64| [[0, y], [2, y], [4, y], [9, y]];
        let chosen: BTreeSet<Square> = [row(0), row(3), row(6)].into_iter().flatten().collect();
        assert_eq!(images.spacing(&chosen), Some([4.0, 6.0]));
        assert_eq!(images.spacing(&row(0).into()), None);
    }

    #[test]
    fn of_too_many_squares_the_nearest_stay() {
        let squares: BTreeSet<Square> = (0..MOST as i64 + 10).map(|column| [column, 0]).collect();
        let camera = camera();
        let images = overhead(&camera, 1.0);
        let kept = images.nearest_to(&Flown::at([[5.0, 0.0]].into_iter()), squares.clone(), MOST);
        assert_eq!(kept.len(), MOST);
        assert_eq!(kept.last(), Some(&[MOST as i64 - 1, 0]));
        let few: BTreeSet<Square> = squares.into_iter().take(3).collect();
        assert_eq!(
            images.nearest_to(&Flown::at([].into_iter()), few.clone(), MOST),
            few
        );
    }
}
