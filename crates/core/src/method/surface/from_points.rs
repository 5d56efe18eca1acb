//! Surface of the sparse points, carved or as terrain (method 1.7 and 1.8).

use nalgebra::Point3;

use super::{
    Steps, SurfaceChoice, SurfaceError, SurfaceSettings, SurfaceStats, WantedGsd, carve, clean,
    delaunay::{Delaunay, Dimension},
    points, terrain, with_edges,
};
use crate::{
    base::tiles::{self, Tile},
    model::{
        georeference::{self, UprightFrame},
        scene::{PointIndex, Scene},
        surface::Surface,
    },
};

/// With fewer points, a terrain is built.
const MIN_CARVED_POINTS: usize = 100;
/// Ratio of the spreads of the points in two directions below which the smaller one counts as zero.
const NO_SPREAD: f64 = 1e-6;
/// Margin of a tile, as a multiple of the longest edge: points farther away hardly change the
/// surface inside.
const MARGIN_EDGES: f64 = 10.0;

/// Builds the surface of the sparse points: whole, or tile by tile, each from the points in and
/// around it, cropped to the tile.
pub(super) fn from_points(
    scene: &Scene,
    wanted: &WantedGsd,
    settings: &SurfaceSettings,
    stats: &mut SurfaceStats,
    whole: &Steps,
) -> Result<Surface, SurfaceError> {
    let points = points::usable_points(scene);
    stats.points = points.len();
    stats.points_dropped = scene.points.len() - points.len();
    let positions: Vec<Point3<f64>> = points.iter().map(|p| scene.points[p.index()]).collect();
    let all = Part {
        scene,
        wanted,
        settings,
        everywhere: &positions,
    };
    match settings.tile_points {
        Some(most) if points.len() > most as usize => {
            let tiles = tiles::split(&positions, most as usize);
            all.tiled(&points, &tiles, stats, whole)
        }
        _ => all.surface(&points, &positions, stats, whole),
    }
}

/// Returns the triangles with their centroids in a tile.
fn within(surface: &Surface, tile: &Tile) -> Surface {
    let centroids = surface.centroids();
    let is_inside: Vec<bool> = centroids.iter().map(|x| tile.contains(x)).collect();
    surface.keep(&is_inside)
}

/// Inputs shared by all tiles of a surface.
struct Part<'a> {
    scene: &'a Scene,
    wanted: &'a WantedGsd,
    settings: &'a SurfaceSettings,
    /// Positions of the points of all tiles.
    everywhere: &'a [Point3<f64>],
}

impl Part<'_> {
    /// `points`: those of `everywhere`.
    fn tiled(
        &self,
        points: &[PointIndex],
        tiles: &[Tile],
        stats: &mut SurfaceStats,
        whole: &Steps,
    ) -> Result<Surface, SurfaceError> {
        stats.tiles = tiles.len();
        let mut merged: Option<Surface> = None;
        for (i, tile) in tiles.iter().enumerate() {
            whole.watcher.check()?;
            let (points, positions) = self.near(points, tile);
            let before = merged.as_ref().map_or(0, |merged| merged.triangles.len());
            let steps = whole.of_tile(i, tiles.len(), before);
            let surface = match self.surface(&points, &positions, stats, &steps) {
                // The points of a tile may coincide or be collinear.
                Err(SurfaceError::TooFewPoints { .. } | SurfaceError::Linear) => continue,
                surface => surface?,
            };
            let own = within(&surface, tile);
            match &mut merged {
                None => merged = Some(own),
                Some(merged) => merged.append(own),
            }
        }
        merged.ok_or(SurfaceError::Linear)
    }

    /// Returns the points in and around a tile, with their positions.
    fn near(&self, points: &[PointIndex], tile: &Tile) -> (Vec<PointIndex>, Vec<Point3<f64>>) {
        let margin = MARGIN_EDGES * self.settings.max_edge_factor * self.wanted.everywhere();
        let near = |(_, position): &(&PointIndex, &Point3<f64>)| tile.is_near(position, margin);
        points.iter().zip(self.everywhere).filter(near).unzip()
    }

    /// Builds the surface of some points, in space or as terrain (method 1.7 and 1.8).
    fn surface(
        &self,
        points: &[PointIndex],
        positions: &[Point3<f64>],
        stats: &mut SurfaceStats,
        steps: &Steps,
    ) -> Result<Surface, SurfaceError> {
        let Self {
            scene,
            wanted,
            settings,
            ..
        } = *self;
        let distinct = distinct_up_to_four(positions);
        if distinct < 4 {
            return Err(SurfaceError::TooFewPoints {
                distinct,
                dropped: stats.points_dropped,
            });
        }
        let spread = georeference::spread(positions);
        let [_, width, length] = spread;
        if width <= NO_SPREAD * length {
            return Err(SurfaceError::Linear);
        }
        steps.reached(1);
        let cleaned = if self.is_terrain(points.len(), spread) {
            self.terrain(positions, stats)?
        } else {
            carved(scene, points, positions, settings, stats, steps)?
        };
        stats.cleaned_triangles += cleaned.triangles.len();
        with_edges(cleaned, wanted, settings, stats, steps)
    }

    /// Returns whether terrain is built of points with this spread.
    fn is_terrain(&self, points: usize, [thickness, _, length]: [f64; 3]) -> bool {
        let is_flat = thickness <= NO_SPREAD * length;
        match self.settings.kind {
            SurfaceChoice::Terrain => true,
            // Points in a plane have no cells to carve.
            SurfaceChoice::Carved => is_flat,
            SurfaceChoice::Auto => {
                is_flat || thickness < self.wanted.everywhere() || points < MIN_CARVED_POINTS
            }
        }
    }

    /// Builds terrain, about one plane in all tiles.
    fn terrain(
        &self,
        positions: &[Point3<f64>],
        stats: &mut SurfaceStats,
    ) -> Result<Surface, SurfaceError> {
        let frame = UprightFrame::new(self.everywhere, self.scene, self.settings.up);
        let edge = self.settings.edge_factor * self.wanted.everywhere();
        let raw = terrain::triangulate(positions, &frame, edge);
        stats.raw_triangles += raw.triangles.len();
        if raw.triangles.is_empty() {
            return Err(SurfaceError::Linear);
        }
        Ok(clean::clean(&raw, &vec![true; raw.triangles.len()]))
    }
}

fn carved(
    scene: &Scene,
    points: &[PointIndex],
    positions: &[Point3<f64>],
    settings: &SurfaceSettings,
    stats: &mut SurfaceStats,
    steps: &Steps,
) -> Result<Surface, SurfaceError> {
    let delaunay = Delaunay::triangulate(positions, steps.watcher)?;
    // Possible only after rounding to the grid: points that are flat before become terrain.
    if delaunay.dimension != Dimension::Three {
        return Err(SurfaceError::Linear);
    }
    steps.reached(2);
    let rays = carve::Rays::choose(scene, &delaunay, points, settings.rays_per_point as usize);
    stats.add(&delaunay, &rays);
    let raw = carve::carve(&delaunay, &rays, settings, steps.watcher)?;
    stats.raw_triangles += raw.surface.triangles.len();
    // Cells and rays are larger than the surface that is copied next.
    drop((delaunay, rays));
    steps.reached(3);
    Ok(clean::clean(&raw.surface, &raw.seen))
}

impl SurfaceStats {
    fn add(&mut self, delaunay: &Delaunay, rays: &carve::Rays) {
        // Mean over the tiles, weighted by vertices.
        let (before, here) = (self.vertices as f64, delaunay.vertex_count() as f64);
        self.sigma = if before == 0.0 {
            rays.sigma
        } else {
            (before * self.sigma + here * rays.sigma) / (before + here)
        };
        self.vertices += delaunay.vertex_count();
        self.cells += delaunay.cells.len();
        self.rays += rays.count();
    }
}

/// Returns the number of distinct points, at most 4.
fn distinct_up_to_four(points: &[Point3<f64>]) -> usize {
    let mut distinct: Vec<&Point3<f64>> = Vec::new();
    for point in points {
        if !distinct.contains(&point) {
            distinct.push(point);
        }
        if distinct.len() == 4 {
            break;
        }
    }
    distinct.len()
}
