//! The area of a region on the map, and what of it the photographs show, also where there is no
//! surface: the ground is a plane through the sparse points there.

use std::{
    ops::Range,
    sync::atomic::{AtomicU32, AtomicU64, Ordering},
};

use nalgebra::{Matrix3, Point3, Vector3};
use rayon::prelude::*;

use super::{
    LOOKED_AT, RegionProperties,
    areas::MapAreas,
    columns::Rectangle,
    polygon::{crosses, polygon_area, ring_edges},
};
use crate::{
    base::{
        median::upper_median,
        progress::{Cancelled, Watcher},
    },
    method::visibility::{Visibility, gsd_at},
    model::{
        georeference::MapFrame,
        scene::{Scene, ViewIndex},
        surface::Surface,
    },
};

/// Cells of the grid around a region.
const CELLS: f64 = 16_384.0;
/// Fewest cells inside, for which the grid is made finer, and the most by which each side is.
const LEAST_INSIDE: f64 = 4096.0;
const FINEST: f64 = 8.0;
/// Most edges of an outline that is drawn on the map.
const MOST_EDGES: usize = 200_000;
/// Points that a plane is fitted to.
const FITTED: usize = 100_000;
/// Multiple of the median distance from the first plane at which points are left out of the second.
const OUTLIER: f64 = 4.0;
/// Steepest slope of a plane; a scene that rises more is a façade, and level ground before it.
const STEEPEST: f64 = 1.0;
/// Resolution, as a multiple of the wanted ground sampling distance, down to which a photograph
/// shows a place: without a limit, an oblique one shows all up to the horizon.
pub const COARSEST: f64 = 4.0;

/// A plane through the sparse points, as a height above the map.
#[derive(Clone, Copy, Debug)]
pub struct GroundPlane {
    frame: MapFrame,
    /// Height at the frame's origin and its rise along the two axes of the map.
    height: f64,
    slope: [f64; 2],
    /// Largest distance of a point from the origin along an axis of the map.
    reach: f64,
}

impl GroundPlane {
    /// Fits a plane by least squares, a second time without outliers; `None` without points.
    pub fn new(frame: &MapFrame, points: &[Point3<f64>]) -> Option<Self> {
        let step = points.len().div_ceil(FITTED).max(1);
        let sample = points.iter().step_by(step);
        let places: Vec<[f64; 3]> = sample.map(|point| frame.local(point)).collect();
        let reach = places
            .iter()
            .flat_map(|[x, y, _]| [x.abs(), y.abs()])
            .fold(0.0, f64::max);
        let [height, x, y] = fitted(&without_outliers(places)?)?;
        Some(Self {
            frame: *frame,
            height,
            slope: [x, y],
            reach,
        })
    }

    /// The place on the ground, world coordinates, at a position on the map.
    pub fn at(&self, [x, y]: [f64; 2]) -> Point3<f64> {
        let z = self.height + self.slope[0] * x + self.slope[1] * y;
        let [right, ahead, up] = self.frame.axes;
        self.frame.origin + right * x + ahead * y + up * z
    }

    /// Up, a unit vector in world coordinates.
    pub fn up(&self) -> Vector3<f64> {
        self.frame.axes[2]
    }

    /// The position on the map that `project` takes to `wanted`, by Newton's method; `None` if that
    /// does not converge.
    pub(super) fn invert(
        &self,
        wanted: [f64; 2],
        project: impl Fn(&Point3<f64>) -> [f64; 2],
    ) -> Option<[f64; 2]> {
        const STEPS: usize = 20;
        let mut at = [0.0; 2];
        for _ in 0..STEPS {
            let change = self.newton_step(at, wanted, &project);
            at = [at[0] + change[0], at[1] + change[1]];
            if !(at[0].is_finite() && at[1].is_finite()) {
                return None;
            }
            if change[0].abs().max(change[1].abs()) < 1e-9 * self.reach {
                return Some(at);
            }
        }
        None
    }

    fn newton_step(
        &self,
        at: [f64; 2],
        wanted: [f64; 2],
        project: impl Fn(&Point3<f64>) -> [f64; 2],
    ) -> [f64; 2] {
        // By differences: the projection may lead to degrees, whose derivatives are not at hand.
        let step = 0.01 * self.reach;
        let here = project(&self.at(at));
        let along = |beside: [f64; 2]| {
            let there = project(&self.at(beside));
            [0, 1].map(|axis| (there[axis] - here[axis]) / step)
        };
        let [along_x, along_y] = [[at[0] + step, at[1]], [at[0], at[1] + step]].map(along);
        let missing = [0, 1].map(|axis| wanted[axis] - here[axis]);
        let determinant = along_x[0] * along_y[1] - along_y[0] * along_x[1];
        [
            (missing[0] * along_y[1] - along_y[0] * missing[1]) / determinant,
            (along_x[0] * missing[1] - missing[0] * along_x[1]) / determinant,
        ]
    }
}

/// Leaves out the places that are far from the plane through all; `None` without places.
fn without_outliers(mut places: Vec<[f64; 3]>) -> Option<Vec<[f64; 3]>> {
    let rough = fitted(&places)?;
    let off = |[x, y, z]: &[f64; 3]| (z - rough[0] - rough[1] * x - rough[2] * y).abs();
    let most = OUTLIER * upper_median(places.iter().map(off))?;
    places.retain(|place| off(place) <= most);
    Some(places)
}

/// Height at the origin and slopes of the plane nearest to some places; level if they do not
/// determine a plane, or a steep one.
fn fitted(places: &[[f64; 3]]) -> Option<[f64; 3]> {
    let count = places.len() as f64;
    let sum = |axis: usize| places.iter().map(|p| p[axis]).sum::<f64>();
    let product = |a: usize, b: usize| places.iter().map(|p| p[a] * p[b]).sum::<f64>();
    let (x, y, z) = (sum(0), sum(1), sum(2));
    let (xx, xy, yy) = (product(0, 0), product(0, 1), product(1, 1));
    let right = Vector3::new(z, product(0, 2), product(1, 2));
    let level = [z / count, 0.0, 0.0];
    if places.is_empty() || !level[0].is_finite() {
        return None;
    }
    let plane = Matrix3::new(count, x, y, x, xx, xy, y, xy, yy)
        .try_inverse()
        .map(|inverse| inverse * right);
    Some(match plane {
        Some(plane) if plane.y.hypot(plane.z) <= STEEPEST => plane.into(),
        _ => level,
    })
}

/// The part of the map that a region covers.
#[derive(Clone, Debug)]
pub enum Footprint<'a> {
    Areas(&'a MapAreas),
    /// Corners of a convex polygon, world coordinates.
    Hull(Vec<Point3<f64>>),
}

impl Footprint<'_> {
    /// Rings on the map, not closed; `None` if a position has none.
    fn rings(&self, plane: &GroundPlane) -> Option<Vec<Vec<[f64; 2]>>> {
        match self {
            Self::Areas(areas) => areas.on_the_map(plane),
            Self::Hull(corners) => {
                let flat = |corner| {
                    let [x, y, _] = plane.frame.local(corner);
                    [x, y]
                };
                Some(vec![corners.iter().map(flat).collect()])
            }
        }
    }

    /// Returns the properties of the region at a place inside. Adds the edges that it looks at to
    /// `looked_at`.
    fn inside(
        &self,
        rings: &[Vec<[f64; 2]>],
        place: [f64; 2],
        plane: &GroundPlane,
        looked_at: &mut u64,
    ) -> Option<RegionProperties> {
        match self {
            Self::Areas(areas) => areas.counted(&plane.at(place), looked_at),
            Self::Hull(_) => {
                let edges = ring_edges(&rings[0]);
                let crossed = edges.filter(|edge| crosses(*edge, place)).count();
                (crossed % 2 == 1).then_some(RegionProperties::INSIDE)
            }
        }
    }

    fn edges(&self) -> usize {
        match self {
            Self::Areas(areas) => areas.edges(),
            Self::Hull(corners) => corners.len(),
        }
    }

    /// Area of the footprint by its rings on the map; an overlap counts once per polygon.
    fn area(&self, rings: &[Vec<[f64; 2]>]) -> f64 {
        match self {
            Self::Areas(areas) => areas.area(rings),
            Self::Hull(_) => polygon_area(rings),
        }
    }
}

/// A square of a region on the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroundCell {
    /// Its centre on the map.
    pub place: [f64; 2],
    /// Wanted ground sampling distance, scene units per pixel of the matched images.
    pub gsd: f64,
    /// Photographs that show it, no coarser than [`COARSEST`].
    pub views: u32,
    /// Some photographs show it, but all of them more coarsely.
    pub too_coarse: bool,
    pub has_surface: bool,
}

/// The area of a region on the map.
#[derive(Clone, Debug)]
pub struct Ground {
    pub plane: GroundPlane,
    /// Side of a cell, scene units.
    pub side: f64,
    /// Square scene units.
    pub area: f64,
    /// The cells inside, row by row.
    pub cells: Vec<GroundCell>,
    /// Outline on the map: rings, not closed.
    pub rings: Vec<Vec<[f64; 2]>>,
}

/// The number of photographs that show a place, down to [`COARSEST`] and more coarsely.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Photographs {
    pub fine: u32,
    pub coarse: u32,
}

/// What the photographs show of a scene.
#[derive(Clone, Copy)]
pub struct Photographed<'a> {
    pub scene: &'a Scene,
    /// Views that don't count, ascending: those without an image, and twins of others.
    pub left_out: &'a [ViewIndex],
    /// Wanted ground sampling distance where the region has none of its own, scene units per pixel
    /// of the matched images.
    pub gsd: f64,
    /// Size of the matched images over that of the model's.
    pub image_scale: f64,
    /// The surface, and by triangle the views that see it and count, where that is known.
    pub surface: Option<(&'a Surface, &'a [Photographs])>,
}

impl Ground {
    /// Divides a region into cells, and counts the photographs of each: on the surface those that
    /// see it, beside it those into which the ground projects. `None` if the region cannot be drawn
    /// on the map, or has an outline that would take long.
    pub fn new(
        footprint: &Footprint,
        photographed: &Photographed,
        frame: &MapFrame,
        watcher: &dyn Watcher,
    ) -> Result<Option<Self>, Cancelled> {
        if footprint.edges() > MOST_EDGES {
            return Ok(None);
        }
        let Some(plane) = GroundPlane::new(frame, &photographed.scene.points) else {
            return Ok(None);
        };
        let Some(rings) = footprint.rings(&plane) else {
            return Ok(None);
        };
        let Some((grid, places)) = places_inside(footprint, &rings, &plane, watcher)? else {
            return Ok(None);
        };
        let cells = photographed.cells(&grid, &places, &plane, watcher)?;
        Ok((!cells.is_empty()).then_some(Self {
            plane,
            side: grid.side,
            area: area(footprint, &rings, cells.len() as f64, grid.side),
            cells,
            rings,
        }))
    }

    /// Share of the area whose cells are so, 0 to 1.
    pub fn share(&self, is_so: impl Fn(&GroundCell) -> bool) -> f64 {
        let so = self.cells.iter().filter(|cell| is_so(cell)).count();
        so as f64 / self.cells.len() as f64
    }
}

/// The area within the rings; that of the cells where the two differ by more than the cells' own
/// error, because polygons overlap.
fn area(footprint: &Footprint, rings: &[Vec<[f64; 2]>], cells: f64, side: f64) -> f64 {
    let of_cells = cells * side * side;
    let edges = rings.iter().flat_map(|ring| ring_edges(ring));
    let outline: f64 = edges.map(|[a, b]| (b[0] - a[0]).hypot(b[1] - a[1])).sum();
    let within = footprint.area(rings);
    if (within - of_cells).abs() <= outline * side {
        within
    } else {
        of_cells
    }
}

/// A place inside a region, on the map, and what the region says there.
type Place = ([f64; 2], RegionProperties);

/// A grid around a region, and the centres of its cells inside.
type Inside = (Grid, Vec<Place>);

/// Divides the region into cells, of which some thousands are inside; `None` if too many edges
/// would be looked at: a comb of a million teeth would take minutes.
fn places_inside(
    footprint: &Footprint,
    rings: &[Vec<[f64; 2]>],
    plane: &GroundPlane,
    watcher: &dyn Watcher,
) -> Result<Option<Inside>, Cancelled> {
    let bounds = Rectangle::around(rings.iter().flatten());
    let Some(mut grid) = Grid::new(&bounds, CELLS) else {
        return Ok(None);
    };
    let in_all = AtomicU64::new(0);
    let inside = |place: [f64; 2]| {
        // The sum doesn't depend on the order, so neither does whether it becomes too large.
        if in_all.load(Ordering::Relaxed) > LOOKED_AT[0] {
            return None;
        }
        let mut looked_at = 0;
        let properties = footprint.inside(rings, place, plane, &mut looked_at);
        in_all.fetch_add(looked_at, Ordering::Relaxed);
        Some((place, properties?))
    };
    let mut places = grid.centres(inside, watcher)?;
    // A narrow or winding region fills little of its rectangle.
    let finer = (LEAST_INSIDE / places.len().max(1) as f64).min(FINEST * FINEST);
    if let Some(fine) = Grid::new(&bounds, CELLS * finer).filter(|_| finer > 1.0) {
        grid = fine;
        places = grid.centres(inside, watcher)?;
    }
    let is_bounded = in_all.into_inner() <= LOOKED_AT[0];
    Ok(is_bounded.then_some((grid, places)))
}

impl Photographed<'_> {
    /// Returns the cells at some centres of a grid.
    fn cells(
        &self,
        grid: &Grid,
        places: &[Place],
        plane: &GroundPlane,
        watcher: &dyn Watcher,
    ) -> Result<Vec<GroundCell>, Cancelled> {
        let on_surface = self.surface.map_or_else(Vec::new, |(surface, views)| {
            grid.photographs(surface, views, &plane.frame)
        });
        let cell = |&(place, properties): &Place| {
            watcher.check()?;
            let gsd = properties.gsd.unwrap_or(self.gsd);
            let seen = on_surface.get(grid.cell(place));
            // Where no view sees the surface, the plane of the ground decides.
            let seen = seen.filter(|seen| **seen != Photographs::default());
            let has_surface = seen.is_some();
            let Photographs { fine, coarse } = seen
                .copied()
                .unwrap_or_else(|| self.of(&plane.at(place), gsd));
            Ok(GroundCell {
                place,
                gsd,
                views: fine,
                too_coarse: fine == 0 && coarse > 0,
                has_surface,
            })
        };
        places.par_iter().map(cell).collect()
    }

    /// Counts by triangle the views that see it. `wishes`: what the region wants of each, as
    /// [`Region::gsd`](super::Region::gsd).
    pub fn of_triangles(
        &self,
        surface: &Surface,
        visibility: &Visibility,
        wishes: &[f32],
        watcher: &dyn Watcher,
    ) -> Result<Vec<Photographs>, Cancelled> {
        let counts: Vec<[AtomicU32; 2]> = surface
            .triangles
            .iter()
            .map(|_| Default::default())
            .collect();
        let count = |view: ViewIndex| {
            watcher.check()?;
            for &triangle in visibility.triangles_seen_by(view) {
                let gsd = gsd_at(self.scene, surface, view, triangle);
                let wish = wishes.get(triangle as usize).map(|&wish| f64::from(wish));
                let wanted = wish.filter(|wish| wish.is_finite()).unwrap_or(self.gsd);
                let is_coarse = Photographs::is_coarse(gsd, wanted * self.image_scale);
                counts[triangle as usize][usize::from(is_coarse)].fetch_add(1, Ordering::Relaxed);
            }
            Ok(())
        };
        let views = visibility.views().into_par_iter();
        views
            .filter(|&view| self.counts(view))
            .try_for_each(count)?;
        let counts = counts.into_iter().map(|of| of.map(AtomicU32::into_inner));
        Ok(counts
            .map(|[fine, coarse]| Photographs { fine, coarse })
            .collect())
    }

    fn counts(&self, view: ViewIndex) -> bool {
        self.left_out.binary_search(&view).is_err()
    }

    /// Counts the photographs into which a place projects. `wanted`: as [`GroundCell::gsd`].
    fn of(&self, place: &Point3<f64>, wanted: f64) -> Photographs {
        let mut photographs = Photographs::default();
        // Whether something hides the place is not known: there is no surface around it.
        for view in self.scene.view_indices().filter(|&view| self.counts(view)) {
            let camera = self.scene.camera_of(view);
            let pose = &self.scene.view(view).cam_from_world;
            let x = pose.camera_from_world(place);
            let pixel = camera.project(&x);
            if pixel.is_some_and(|pixel| camera.contains(&pixel)) {
                let gsd = camera.depth(&x) / camera.mean_focal_length();
                let is_coarse = Photographs::is_coarse(gsd, wanted * self.image_scale);
                photographs.coarse += u32::from(is_coarse);
                photographs.fine += u32::from(!is_coarse);
            }
        }
        photographs
    }
}

impl Photographs {
    /// Returns whether one with a ground sampling distance is too coarse, where another is wanted.
    fn is_coarse(gsd: f64, wanted: f64) -> bool {
        // In the comparison alone, NaN would count as fine.
        gsd.is_nan() || gsd > COARSEST * wanted
    }
}

/// A grid of squares on the map.
struct Grid {
    low: [f64; 2],
    side: f64,
    columns: usize,
    rows: usize,
}

impl Grid {
    fn new(bounds: &Rectangle, cells: f64) -> Option<Self> {
        let [width, height] = [0, 1].map(|axis| bounds.high[axis] - bounds.low[axis]);
        // A sliver is no longer than all cells in one row.
        let side = (width * height / cells)
            .sqrt()
            .max(width.max(height) / cells);
        let count = |length: f64| ((length / side).ceil() as usize).max(1);
        (side > 0.0 && side.is_finite()).then(|| Self {
            low: bounds.low,
            side,
            columns: count(width),
            rows: count(height),
        })
    }

    /// Returns the centres of the cells that `counted` keeps, row by row.
    fn centres(
        &self,
        counted: impl Fn([f64; 2]) -> Option<Place> + Sync,
        watcher: &dyn Watcher,
    ) -> Result<Vec<Place>, Cancelled> {
        let cells = (0..self.columns * self.rows).into_par_iter();
        let centres = cells.map(|cell| {
            watcher.check()?;
            Ok(counted(self.centre(cell)))
        });
        let centres = centres.collect::<Result<Vec<Option<Place>>, Cancelled>>()?;
        Ok(centres.into_iter().flatten().collect())
    }

    fn centre(&self, cell: usize) -> [f64; 2] {
        let at = [cell % self.columns, cell / self.columns];
        [0, 1].map(|axis| self.low[axis] + (at[axis] as f64 + 0.5) * self.side)
    }

    /// The cell of a position inside the grid.
    fn cell(&self, place: [f64; 2]) -> usize {
        let [column, row] =
            [0, 1].map(|axis| ((place[axis] - self.low[axis]) / self.side) as usize);
        row * self.columns + column
    }

    /// By cell: the photographs that show the surface at its centre, the most of several layers.
    /// `of`: by triangle.
    fn photographs(
        &self,
        surface: &Surface,
        of: &[Photographs],
        frame: &MapFrame,
    ) -> Vec<Photographs> {
        let flat: Vec<[f64; 2]> = surface
            .vertices
            .par_iter()
            .map(|vertex| frame.local(vertex))
            .map(|[x, y, _]| [x, y])
            .collect();
        let mut most = vec![Photographs::default(); self.columns * self.rows];
        for (corners, &seen) in surface.triangles.iter().zip(of) {
            let corners = corners.map(|corner| flat[corner as usize]);
            if seen != Photographs::default() {
                self.for_each_inside(corners, |cell| most[cell] = most[cell].max(seen));
            }
        }
        most
    }

    /// Calls `each` with the cells whose centres are in a triangle.
    fn for_each_inside(&self, corners: [[f64; 2]; 3], mut each: impl FnMut(usize)) {
        let bounds = Rectangle::around(&corners);
        let [a, b, c] = corners;
        let edges = [[a, b], [b, c], [c, a]];
        for row in self.centres_within(&bounds, 1, self.rows) {
            for column in self.centres_within(&bounds, 0, self.columns) {
                let cell = row * self.columns + column;
                let centre = self.centre(cell);
                // From inside a triangle a ray crosses one side, from outside none or two.
                if edges.iter().filter(|edge| crosses(**edge, centre)).count() == 1 {
                    each(cell);
                }
            }
        }
    }

    /// Returns which of `count` columns (axis 0) or rows (1) have their centres in some bounds.
    fn centres_within(&self, bounds: &Rectangle, axis: usize, count: usize) -> Range<usize> {
        let at = |x: f64| (x - self.low[axis]) / self.side - 0.5;
        let (first, last) = (at(bounds.low[axis]).ceil(), at(bounds.high[axis]).floor());
        (first.max(0.0) as usize)..((last + 1.0).clamp(0.0, count as f64) as usize)
    }
}

#[cfg(test)]
mod tests;
