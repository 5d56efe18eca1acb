//! Soft visibility votes of the rays from cameras to points, and extraction of the facets between
//! outside and inside (method 1.2).
//!
//! Labatut, Pons, Keriven, "Efficient Multi-View Reconstruction of Large-Scale Scenes using
//! Interest Points, Delaunay Triangulation and Graph Cuts" (2007), with the soft visibility of
//! "Robust and Efficient Surface Reconstruction from Range Data" (2009). Votes are integers, so
//! their sum does not depend on the order in which threads add them.

use std::sync::atomic::{AtomicU32, Ordering};

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::{
    cut::{Capacities, minimum_cut},
    delaunay::{Delaunay, FACET_VERTICES, Facet, INFINITE},
    points::{depth_sigma, extremes, views_of},
};
use crate::{
    base::{
        large_pages,
        median::upper_median,
        progress::{Cancelled, Watcher},
    },
    method::surface::SurfaceSettings,
    model::{
        scene::{PointIndex, Scene, ViewIndex},
        surface::{Surface, SurfaceKind},
    },
};

/// Units of a full vote; fewer where the number of rays could overflow 32 bits.
const UNITS: f64 = 1024.0;
/// Distance from the point, in sigma, beyond which a vote is full to less than half a unit.
const FULL_VOTE_SIGMA: f64 = 4.5;
/// Vertices per task: about a millisecond of work.
const CHUNK: usize = 512;
/// Cosine of the largest angle between a facet's normal and a ray that sees it: 85 degrees, as in
/// method 2.
const MIN_FACING_COSINE: f64 = 0.087_155_742_747_658_17;

/// The voting rays: for each vertex, the centres of some of the cameras that see it.
pub struct Rays {
    /// Start of each vertex's rays, and the end of the last: vertices + 1 entries.
    offsets: Vec<u32>,
    views: Vec<ViewIndex>,
    /// Camera centre of each view of the scene.
    centres: Vec<Point3<f64>>,
    /// Median depth uncertainty of the vertices, scene units.
    pub sigma: f64,
}

impl Rays {
    /// Selects the rays of each vertex from the tracks of its points: at most `most`, the angular
    /// extremes among them.
    pub fn choose(scene: &Scene, delaunay: &Delaunay, points: &[PointIndex], most: usize) -> Self {
        let cameras = ViewCameras::new(scene);
        let (starts, members) = points_by_vertex(delaunay, points);
        let choose_chunk = |vertices: &[u32]| {
            let mut chunk = RayChunk::default();
            let mut views = Vec::new();
            for &v in vertices {
                let members =
                    &members[starts[v as usize] as usize..starts[v as usize + 1] as usize];
                views_of(scene, members, &mut views);
                chunk.add(&delaunay.position(v), &views, &cameras, most);
            }
            chunk
        };
        let vertices: Vec<u32> = (0..delaunay.vertex_count() as u32).collect();
        let chunks: Vec<RayChunk> = vertices.par_chunks(CHUNK).map(choose_chunk).collect();
        Self::of_chunks(chunks, cameras.centres)
    }

    fn of_chunks(chunks: Vec<RayChunk>, centres: Vec<Point3<f64>>) -> Self {
        let mut rays = Self {
            offsets: vec![0],
            views: Vec::new(),
            centres,
            sigma: 0.0,
        };
        let mut sigmas = Vec::new();
        for chunk in chunks {
            let last = rays.views.len() as u32;
            rays.offsets.extend(chunk.ends.iter().map(|end| last + end));
            rays.views.extend(chunk.views);
            sigmas.extend(chunk.sigmas);
        }
        rays.sigma = upper_median(sigmas).unwrap_or(0.0);
        rays
    }

    pub fn count(&self) -> usize {
        self.views.len()
    }

    /// Returns the camera centres of the vertex's rays.
    pub fn centres(&self, vertex: u32) -> impl Iterator<Item = &Point3<f64>> {
        let range =
            self.offsets[vertex as usize] as usize..self.offsets[vertex as usize + 1] as usize;
        self.views[range].iter().map(|v| &self.centres[v.index()])
    }
}

/// Centre and focal length of each view.
struct ViewCameras {
    centres: Vec<Point3<f64>>,
    focals: Vec<f64>,
}

impl ViewCameras {
    fn new(scene: &Scene) -> Self {
        let views = || scene.view_indices();
        let centre = |view| scene.view(view).cam_from_world.centre();
        let focal = |view| scene.camera_of(view).mean_focal_length();
        Self {
            centres: views().map(centre).collect(),
            focals: views().map(focal).collect(),
        }
    }
}

/// Rays of consecutive vertices.
#[derive(Default)]
struct RayChunk {
    /// End of each vertex's views.
    ends: Vec<u32>,
    views: Vec<ViewIndex>,
    sigmas: Vec<f64>,
}

impl RayChunk {
    fn add(
        &mut self,
        at: &Point3<f64>,
        views: &[ViewIndex],
        ViewCameras { centres, focals }: &ViewCameras,
        most: usize,
    ) {
        let direction = |v: &ViewIndex| {
            (centres[v.index()] - at)
                .try_normalize(0.0)
                .unwrap_or_default()
        };
        let directions: Vec<Vector3<f64>> = views.iter().map(direction).collect();
        self.views
            .extend(extremes(&directions, most).into_iter().map(|i| views[i]));
        self.ends.push(self.views.len() as u32);
        self.sigmas.extend(depth_sigma(
            at,
            views
                .iter()
                .map(|v| (centres[v.index()], focals[v.index()])),
        ));
    }
}

/// Returns the points of each vertex (CSR), ascending. `points`: those that were triangulated.
fn points_by_vertex(delaunay: &Delaunay, points: &[PointIndex]) -> (Vec<u32>, Vec<PointIndex>) {
    let mut starts = vec![0u32; delaunay.vertex_count() + 1];
    delaunay
        .vertex_of_point
        .iter()
        .for_each(|&v| starts[v as usize + 1] += 1);
    for v in 0..delaunay.vertex_count() {
        starts[v + 1] += starts[v];
    }
    let mut fill = starts.clone();
    let mut members = vec![PointIndex(0); points.len()];
    for (&point, &v) in points.iter().zip(&delaunay.vertex_of_point) {
        members[fill[v as usize] as usize] = point;
        fill[v as usize] += 1;
    }
    (starts, members)
}

/// Votes of a cell while they are accumulated; same layout as [`Capacities`].
#[derive(Default)]
struct Votes {
    facets: [AtomicU32; 4],
    source: AtomicU32,
    sink: AtomicU32,
}

fn cast(vote: &AtomicU32, units: u32) {
    vote.fetch_add(units, Ordering::Relaxed);
}

/// Computes the capacities of the cells: votes of the rays, and quality of the facets.
///
/// # Errors
/// Cancellation.
pub fn capacities(
    delaunay: &Delaunay,
    rays: &Rays,
    settings: &SurfaceSettings,
    watcher: &dyn Watcher,
) -> Result<Vec<Capacities>, Cancelled> {
    // One vote per ray and facet at most, so no sum can overflow.
    let most = f64::from(u32::MAX)
        / (rays.count().max(1) as f64 * settings.ray_weight.max(f64::MIN_POSITIVE));
    let units = UNITS.min(most);
    let ballot = Ballot::new(delaunay, rays, settings, units);
    let vertices: Vec<u32> = (0..delaunay.vertex_count() as u32).collect();
    vertices.par_chunks(CHUNK).try_for_each(|chunk| {
        chunk
            .iter()
            .for_each(|&v| ballot.cast_rays(delaunay, rays, v));
        watcher.check()
    })?;
    let quality = qualities(delaunay, settings.quality_weight * units);
    let votes = ballot.votes.into_par_iter().enumerate();
    let with_quality = |(c, votes)| with_quality(delaunay, &quality, c, votes);
    Ok(votes.map(with_quality).collect())
}

/// Adds to the votes on the facets of a cell the worse quality of those of the two cells there.
fn with_quality(delaunay: &Delaunay, quality: &[[u32; 4]], c: usize, votes: Votes) -> Capacities {
    let facet = |i: usize| {
        let beyond = delaunay.cells[c].neighbours[i];
        // 1 - min(cos φ, cos ψ) of method 1.2 is the larger of the two.
        let worse = quality[c][i].max(quality[beyond.cell() as usize][beyond.index()]);
        votes.facets[i]
            .load(Ordering::Relaxed)
            .saturating_add(worse)
    };
    Capacities {
        facets: [0, 1, 2, 3].map(facet),
        source: votes.source.into_inner(),
        sink: votes.sink.into_inner(),
    }
}

struct Ballot {
    votes: Vec<Votes>,
    /// Units of a full vote.
    full: f64,
    sigma: f64,
    behind_sigma: f64,
}

impl Ballot {
    fn new(delaunay: &Delaunay, rays: &Rays, settings: &SurfaceSettings, units: f64) -> Self {
        let cells = (0..delaunay.cells.len()).into_par_iter();
        Self {
            votes: cells.map(|_| Votes::default()).collect(),
            full: settings.ray_weight * units,
            // Points are rounded to the grid, and with a sigma of 0 a vote could be NaN.
            sigma: (rays.sigma * settings.sigma_factor).max(delaunay.step()),
            behind_sigma: settings.behind_sigma,
        }
    }

    /// Casts all rays of one vertex.
    fn cast_rays(&self, delaunay: &Delaunay, rays: &Rays, vertex: u32) {
        let (at, start) = (delaunay.position(vertex), delaunay.cell_of(vertex));
        // Rays to cameras are similar, and so are those away from them.
        let (mut ray, mut behind) = (delaunay.ray(vertex), delaunay.ray(vertex));
        for centre in rays.centres(vertex) {
            let towards = centre - at;
            let length = towards.norm();
            if length == 0.0 {
                continue;
            }
            ray.aim(centre, start);
            for crossing in ray.by_ref() {
                let beyond = delaunay.neighbour(crossing.facet);
                cast(
                    // On the arc from the camera's side to the point's: it is a surface in this
                    // direction that would hide the point.
                    &self.votes[beyond.cell() as usize].facets[beyond.index()],
                    self.vote(crossing.t * length),
                );
            }
            cast(&self.votes[ray.cell() as usize].source, self.full as u32);
            behind.aim(
                &(at - towards * (self.behind_sigma * self.sigma / length)),
                ray.first(),
            );
            // The cells on the way get nothing, only that in which it ends.
            behind.by_ref().for_each(drop);
            cast(&self.votes[behind.cell() as usize].sink, self.full as u32);
        }
    }

    /// Returns the soft visibility at a distance from the ray's point: α (1 − exp(−d² / 2σ²)).
    fn vote(&self, distance: f64) -> u32 {
        let sigmas = distance / self.sigma;
        if sigmas > FULL_VOTE_SIGMA {
            return self.full as u32;
        }
        (self.full * (1.0 - (-0.5 * sigmas * sigmas).exp())) as u32
    }
}

/// Returns the quality of the facets of each cell.
fn qualities(delaunay: &Delaunay, weight: f64) -> Vec<[u32; 4]> {
    let cells = (0..delaunay.cells.len() as u32).into_par_iter();
    cells.map(|cell| quality(delaunay, cell, weight)).collect()
}

/// Returns `weight` times 1 − cosine of the angle between each facet and the cell's circumsphere.
/// For an infinite cell, the sphere is the plane of its hull facet (opposite to corner 3), and its
/// other facets are perpendicular to it.
fn quality(delaunay: &Delaunay, cell: u32, weight: f64) -> [u32; 4] {
    if delaunay.is_infinite(cell) {
        return [weight as u32, weight as u32, weight as u32, 0];
    }
    let corners = delaunay.cells[cell as usize]
        .vertices
        .map(|v| delaunay.position(v));
    let centre = circumcentre(&corners);
    let radius = (centre - corners[0]).norm();
    std::array::from_fn(|i| {
        let [a, b, c] = FACET_VERTICES[i].map(|corner| corners[corner]);
        let outward = (b - a).cross(&(c - a)).normalize();
        let cosine = outward.dot(&(a - centre)) / radius;
        // Cells that are flat in floating point have no centre.
        if cosine.is_finite() {
            (weight * (1.0 - cosine.clamp(-1.0, 1.0))) as u32
        } else {
            weight as u32
        }
    })
}

/// Returns the centre of the sphere through four points.
fn circumcentre(corners: &[Point3<f64>; 4]) -> Point3<f64> {
    let [a, b, c] = [1, 2, 3].map(|i| corners[i] - corners[0]);
    let numerator = b.cross(&c) * a.norm_squared()
        + c.cross(&a) * b.norm_squared()
        + a.cross(&b) * c.norm_squared();
    corners[0] + numerator / (2.0 * a.dot(&b.cross(&c)))
}

/// The raw surface, and whether a ray sees each facet.
pub struct CarvedSurface {
    pub surface: Surface,
    pub seen: Vec<bool>,
}

/// Extracts the facets between outside and inside by the minimum cut, oriented outwards.
///
/// # Errors
/// Cancellation.
pub fn carve(
    delaunay: &Delaunay,
    rays: &Rays,
    settings: &SurfaceSettings,
    watcher: &dyn Watcher,
) -> Result<CarvedSurface, Cancelled> {
    let capacities = capacities(delaunay, rays, settings, watcher)?;
    // The cut needs more memory than all before it.
    large_pages::return_freed_memory();
    let outside = minimum_cut(&delaunay.cells, capacities, watcher)?.outside;
    Ok(surface(delaunay, rays, &outside))
}

/// Collects the facets between outside and inside cells.
pub fn surface(delaunay: &Delaunay, rays: &Rays, outside: &[bool]) -> CarvedSurface {
    let facets_of = |cell: u32| {
        let is_surface = move |f: &Facet| {
            !outside[cell as usize]
                && outside[delaunay.neighbour(*f).cell() as usize]
                && delaunay.facet_vertices(*f).iter().all(|&v| v != INFINITE)
        };
        (0..4)
            .map(move |i| Facet::new(cell, i))
            .filter(is_surface)
            .map(|f| delaunay.facet_vertices(f))
    };
    let triangles: Vec<[u32; 3]> = (0..delaunay.cells.len() as u32)
        .flat_map(facets_of)
        .collect();
    let seen = triangles
        .par_iter()
        .map(|t| is_seen(delaunay, rays, t))
        .collect();
    let vertices = (0..delaunay.vertex_count() as u32)
        .map(|v| delaunay.position(v))
        .collect();
    CarvedSurface {
        surface: Surface {
            kind: SurfaceKind::Carved,
            vertices,
            triangles,
        },
        seen,
    }
}

/// Returns whether a ray reaches a corner of the facet from its outer side.
fn is_seen(delaunay: &Delaunay, rays: &Rays, triangle: &[u32; 3]) -> bool {
    let [a, b, c] = triangle.map(|v| delaunay.position(v));
    let normal = (b - a).cross(&(c - a)).normalize();
    triangle.iter().zip([a, b, c]).any(|(&v, at)| {
        rays.centres(v).any(|centre| {
            let towards = centre - at;
            normal.dot(&towards) > MIN_FACING_COSINE * towards.norm()
        })
    })
}
