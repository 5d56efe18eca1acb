//! The places on which pilot maps agree, and the maps that take part in each.

use std::collections::HashSet;

use nalgebra::Point3;
use rayon::prelude::*;

use super::{sweep::PilotMap, thumbnail::LONG_SIDE};
use crate::{
    base::progress::{Cancelled, Watcher},
    method::target::GSD_MARGIN,
    model::{camera::Camera, cluster::ViewCluster, scene::ViewIndex},
};

/// Only every second row and column gives places: those between are in the same cells.
const LEAST_STEP: usize = 2;
/// Pixels that are looked at for places in all.
const MOST_PIXELS: usize = 1 << 22;
/// Edge of a cell, in wanted GSDs of the thumbnails.
const EDGE: f64 = 2.0;
/// Pixels of a map, in wanted GSDs of the place, from which it leaves cells without a point: a point
/// counts within 2 g_d of a cell's centre.
const REACH: f64 = 4.0;
/// Maps that agree on a sure place.
const SURE: usize = 3;
/// Weight of a place on which two maps agree: half of those are chance.
const UNSURE_WEIGHT: f64 = 0.5;
/// Places of a map at which it is looked whether another shows the same, along each axis.
const PROBES: usize = 8;

/// Cells of the scene on which at least two pilot maps agree.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Places {
    /// A point of each cell, world coordinates.
    pub centres: Vec<Point3<f64>>,
    /// Half the edge of the cell, scene units.
    pub sizes: Vec<f32>,
    /// How much the place counts: less where only two maps agree.
    pub weights: Vec<f64>,
    /// Key views of the maps, ascending.
    pub views: Vec<ViewIndex>,
    /// For each of them, the places on which its map agrees with others, ascending, with
    /// [`Self::worth`].
    pub parts: Vec<Vec<(u32, f32)>>,
}

impl Places {
    /// Finds the places of confirmed maps, one per cluster.
    pub fn new(
        clusters: &[ViewCluster],
        maps: &[Option<PilotMap>],
        watcher: &dyn Watcher,
    ) -> Result<Self, Cancelled> {
        let overlapping = overlapping(maps);
        watcher.check()?;
        let candidates = candidates(maps, &overlapping);
        watcher.check()?;
        let taking_part = candidates.par_iter().map(|candidate| {
            let own = candidate.map;
            let others = overlapping[own as usize].iter().copied().chain([own]);
            let agrees = |map: u32| {
                let of_map = maps[map as usize].as_ref()?;
                let z = of_map.agrees(&candidate.place)?;
                Some((map, z / of_map.focal[0]))
            };
            others.filter_map(agrees).collect::<Vec<(u32, f64)>>()
        });
        let taking_part: Vec<Vec<(u32, f64)>> = taking_part.collect();
        watcher.check()?;
        let mut places = Self {
            views: clusters.iter().map(|cluster| cluster.key).collect(),
            parts: vec![Vec::new(); maps.len()],
            ..Self::default()
        };
        for (candidate, of_place) in candidates.iter().zip(taking_part) {
            if of_place.len() < 2 {
                continue;
            }
            let index = places.centres.len() as u32;
            let is_sure = of_place.len() >= SURE;
            for (map, gsd) in of_place {
                let worth = worth(candidate.size, gsd);
                places.parts[map as usize].push((index, worth));
            }
            places.centres.push(candidate.place);
            places.sizes.push(candidate.size);
            places
                .weights
                .push(if is_sure { 1.0 } else { UNSURE_WEIGHT });
        }
        Ok(places)
    }

    /// Returns the places in which the map of a view takes part.
    pub fn of_view(&self, view: ViewIndex) -> &[(u32, f32)] {
        match self.views.binary_search(&view) {
            Ok(place) => &self.parts[place],
            Err(_) => &[],
        }
    }

    /// Returns the share of cells like that of a place in which a map of this camera has a point, 0 to
    /// 1: less than 1 where its pixels are larger than their reach.
    pub fn worth(&self, place: u32, camera: &Camera, depth: f64) -> f32 {
        let thumbnail = LONG_SIDE / f64::from(camera.width.max(camera.height));
        let gsd = depth / (camera.mean_focal_length() * thumbnail);
        worth(self.sizes[place as usize], gsd)
    }

    pub fn is_empty(&self) -> bool {
        self.centres.is_empty()
    }
}

fn worth(size: f32, gsd: f64) -> f32 {
    (REACH * f64::from(size) / gsd).powi(2).min(1.0) as f32
}

/// A point of a cell that is not yet taken.
struct Candidate {
    map: u32,
    place: Point3<f64>,
    size: f32,
}

/// Returns a point of each cell, the first in the order of maps and pixels.
fn candidates(maps: &[Option<PilotMap>], overlapping: &[Vec<u32>]) -> Vec<Candidate> {
    let pixels: usize = maps.iter().flatten().map(|map| map.inverse.len()).sum();
    let step = (pixels as f64 / MOST_PIXELS as f64).sqrt().ceil() as usize;
    let step = step.max(LEAST_STEP);
    let of_map = |(own, map): (usize, &Option<PilotMap>)| {
        let Some(map) = map else {
            return Vec::new();
        };
        let is_thinned = |pixel: usize| {
            let (x, y) = (pixel % map.width, pixel / map.width);
            x % step == step / 2 && y % step == step / 2
        };
        let found = map.places().filter(|(pixel, _)| is_thinned(*pixel));
        let with_octave = found.filter_map(|(_, place)| {
            let others = overlapping[own].iter().copied().chain([own as u32]);
            let gsd = |other: u32| {
                let other = maps[other as usize].as_ref()?;
                other.pixel(&place).map(|(_, z)| z / other.focal[0])
            };
            let finest = others.filter_map(gsd).min_by(f64::total_cmp)?;
            Some((place, (GSD_MARGIN * finest).log2().round() as i32))
        });
        with_octave.collect()
    };
    let found: Vec<Vec<(Point3<f64>, i32)>> = maps.par_iter().enumerate().map(of_map).collect();
    let mut taken = HashSet::new();
    let mut candidates = Vec::new();
    for (map, places) in (0..).zip(found) {
        for (place, octave) in places {
            let edge = EDGE * f64::from(octave).exp2();
            let cell = [0, 1, 2].map(|axis| (place[axis] / edge).floor() as i64);
            if taken.insert((octave, cell)) {
                let size = (edge / EDGE) as f32;
                candidates.push(Candidate { map, place, size });
            }
        }
    }
    candidates
}

/// Returns for each map the others that show some of its places.
fn overlapping(maps: &[Option<PilotMap>]) -> Vec<Vec<u32>> {
    let probes = |map: &PilotMap| -> Vec<Point3<f64>> {
        let [across, down] = [map.width, map.height].map(|side| (side / PROBES).max(1));
        let is_probe = |pixel: usize| {
            let (x, y) = (pixel % map.width, pixel / map.width);
            x % across == across / 2 && y % down == down / 2
        };
        let places = map.places().filter(|(pixel, _)| is_probe(*pixel));
        places.map(|(_, place)| place).collect()
    };
    let of_map = |(own, map): (usize, &Option<PilotMap>)| {
        let probes = map.as_ref().map(probes).unwrap_or_default();
        let shows_some = |&other: &u32| {
            other as usize != own
                && maps[other as usize]
                    .as_ref()
                    .is_some_and(|other| probes.iter().any(|place| other.pixel(place).is_some()))
        };
        (0..maps.len() as u32).filter(shows_some).collect()
    };
    maps.par_iter().enumerate().map(of_map).collect()
}
