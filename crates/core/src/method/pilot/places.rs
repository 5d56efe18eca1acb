//! The places that pilot maps show, and the maps that take part in each.

use std::collections::HashSet;

use nalgebra::Point3;
use rayon::prelude::*;

use super::{confirm::take_all, sweep::PilotMap, thumbnail::LONG_SIDE};
use crate::{
    base::progress::{Cancelled, Watcher},
    method::target::GSD_MARGIN,
    model::{camera::Camera, cluster::ViewCluster, scene::ViewIndex},
};

/// Only every second row and column gives places: those between are in the same cells. With fewer,
/// cells that few maps show would be missed, and those that many show found all the same.
const STEP: usize = 2;
/// Parts of maps in places: of more, every second place is left out, then every second of those
/// left. Where 1,236 views overlap so much that 115 maps agree on a place, an eighth of the places
/// gives no worse an order than a quarter did.
const MOST_PARTS: usize = 1 << 24;
/// Parts per pixel that is looked at, at most: measured on a survey of 485 views, whose places have
/// 30 maps each.
const PARTS_PER_PIXEL: usize = 10;
/// Bytes per part, in the places and in the tables that are ranked by; measured likewise.
const BYTES_PER_PART: usize = 47;
/// Edge of a cell, in wanted GSDs of the thumbnails.
const EDGE: f64 = 2.0;
/// Places of a map at which it is looked whether another shows the same.
const PROBES: usize = 64;

/// Cells of the scene on which pilot maps agree or, where fusion keeps what a single map shows, of
/// which one has a depth.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Places {
    /// A point of each cell, world coordinates.
    pub centres: Vec<Point3<f64>>,
    /// Wanted GSD there, in pixels of the thumbnails: half the edge of the cell, scene units.
    pub sizes: Vec<f32>,
    /// Area of the cells in which the cloud of the matched maps is measured (method 8), brought to
    /// the size of the thumbnails, over that of the place's cell: GSDs are rounded to powers of two
    /// at either size.
    pub measured_area: Vec<f32>,
    /// Maps that agree on the place.
    pub agreement: Vec<Agreement>,
    /// Key views of the maps, ascending.
    pub views: Vec<ViewIndex>,
    /// For each of them, the places in which its map takes part, ascending.
    pub parts: Vec<Vec<Part>>,
}

/// Maps that agree on a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Agreement {
    /// No other map confirms it.
    Single = 1,
    Two,
    More,
}

impl Agreement {
    /// Returns the agreement of a number of maps; `None` for one, with which none agrees.
    fn of(maps: usize) -> Option<Self> {
        match maps {
            ..=1 => None,
            2 => Some(Self::Two),
            3.. => Some(Self::More),
        }
    }
}

/// A place in which a map takes part.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Part {
    pub place: u32,
    /// Pixels of the map per wanted pixel of the place.
    pub density: f32,
    /// Part of what the map has there that fusion is expected to keep, 0 to 1.
    pub kept: f32,
}

impl Places {
    /// Finds the places of the maps of all clusters: those that others confirm; then, if fusion
    /// wants no more than `support` = 1 of them, those that a single one shows. `smaller`: size of
    /// the thumbnails over that of the matched images.
    pub fn new(
        clusters: &[ViewCluster],
        mut maps: Vec<Option<PilotMap>>,
        support: u32,
        smaller: f64,
        watcher: &dyn Watcher,
    ) -> Result<Self, Cancelled> {
        let mut places = Self {
            views: clusters.iter().map(|cluster| cluster.key).collect(),
            parts: vec![Vec::new(); clusters.len()],
            ..Self::default()
        };
        let mut sample = Sample::default();
        let mut add = |maps: &[Option<PilotMap>], agreement: fn(usize) -> Option<Agreement>| {
            places.add(maps, agreement, &mut sample, smaller, watcher)
        };
        add(&maps, Agreement::of)?;
        if support == 1 {
            // Depths that are left agree by chance.
            take_all(&mut maps);
            add(&maps, |_| Some(Agreement::Single))?;
        }
        Ok(places)
    }

    /// Adds the places of some maps in cells that have none yet. `agreement`: of a number of maps.
    fn add(
        &mut self,
        maps: &[Option<PilotMap>],
        agreement: fn(usize) -> Option<Agreement>,
        sample: &mut Sample,
        smaller: f64,
        watcher: &dyn Watcher,
    ) -> Result<(), Cancelled> {
        for (own, others) in overlapping(maps).iter().enumerate() {
            watcher.check()?;
            // Places are found by all threads but taken in the order of the pixels: a cell's first
            // place is the same on any number of threads.
            for found in shown(maps, own, others, sample) {
                let agreement = agreement(found.maps.len());
                if let Some(agreement) = agreement.filter(|_| sample.takes(found.cell())) {
                    self.push(&found, agreement, smaller);
                }
            }
            while self.parts.iter().map(Vec::len).sum::<usize>() > MOST_PARTS {
                self.thin_out(&sample.halve());
            }
        }
        Ok(())
    }

    /// Removes the places that are not `sampled`.
    fn thin_out(&mut self, sampled: &[bool]) {
        let mut number = 0;
        let renumbered: Vec<Option<u32>> = sampled
            .iter()
            .map(|is_sampled| {
                number += u32::from(*is_sampled);
                is_sampled.then(|| number - 1)
            })
            .collect();
        for parts in &mut self.parts {
            parts.retain_mut(|part| {
                let new = renumbered[part.place as usize];
                part.place = new.unwrap_or_default();
                new.is_some()
            });
            // Otherwise the lists would keep the memory for which they are thinned out.
            parts.shrink_to_fit();
        }
        retain(&mut self.centres, sampled);
        retain(&mut self.sizes, sampled);
        retain(&mut self.measured_area, sampled);
        retain(&mut self.agreement, sampled);
    }

    fn push(&mut self, found: &Shown, agreement: Agreement, smaller: f64) {
        let index = self.centres.len() as u32;
        let size = f64::from(octave(found.finest)).exp2();
        let measured = f64::from(octave(found.finest * smaller)).exp2() / smaller;
        self.measured_area.push((measured / size).powi(2) as f32);
        let size = size as f32;
        for agreeing in &found.maps {
            self.parts[agreeing.map as usize].push(Part {
                place: index,
                density: density(size, agreeing.gsd),
                kept: f32::from(u8::from(agreeing.is_kept)),
            });
        }
        self.centres.push(found.place);
        self.sizes.push(size);
        self.agreement.push(agreement);
    }

    /// Returns the places in which the map of a view takes part.
    pub fn of_view(&self, view: ViewIndex) -> &[Part] {
        match self.views.binary_search(&view) {
            Ok(place) => &self.parts[place],
            Err(_) => &[],
        }
    }

    /// Returns the pixels of a map of this camera at a depth, per wanted pixel of a place.
    pub fn density(&self, place: u32, camera: &Camera, depth: f64) -> f32 {
        let thumbnail = LONG_SIDE / f64::from(camera.width.max(camera.height));
        let gsd = depth / (camera.mean_focal_length() * thumbnail);
        density(self.sizes[place as usize], gsd)
    }
}

/// Returns the memory that the places of maps with so many pixels need, with the tables that are
/// ranked by.
pub(super) fn bytes(pixels: usize) -> u64 {
    let parts = PARTS_PER_PIXEL * pixels / STEP.pow(2);
    (BYTES_PER_PART * parts.min(MOST_PARTS)) as u64
}

/// Returns the wanted GSD where this is the finest, as the exponent of a power of two.
fn octave(finest: f64) -> i32 {
    // Rounded, so that points next to each other are in cells of one grid although their finest
    // GSDs differ a little.
    (GSD_MARGIN * finest).log2().round() as i32
}

fn density(size: f32, gsd: f64) -> f32 {
    (f64::from(size) / gsd).powi(2) as f32
}

/// A place that maps show.
struct Shown {
    place: Point3<f64>,
    /// Finest GSD of the thumbnails that show it, scene units.
    finest: f64,
    maps: Vec<Agreeing>,
}

/// A map that agrees on a place.
struct Agreeing {
    map: u32,
    gsd: f64,
    is_kept: bool,
}

impl Shown {
    /// Returns a place without the maps that agree on it; `None` if none of these may show it.
    fn new(maps: &[Option<PilotMap>], showing: &[u32], place: &Point3<f64>) -> Option<Self> {
        let mut finest = f64::INFINITY;
        for map in showing
            .iter()
            .filter_map(|&map| maps[map as usize].as_ref())
        {
            let gsd = map.camera.pose.camera_from_world(place).z / map.camera.focal[0];
            // Most are coarser than one before, and need not be projected.
            if gsd > 0.0 && gsd < finest && map.camera.pixel(place).is_some() {
                finest = gsd;
            }
        }
        finest.is_finite().then_some(Self {
            place: *place,
            finest,
            maps: Vec::new(),
        })
    }

    /// Adds the maps that agree on the place; `None` if none does.
    fn with_agreeing(mut self, maps: &[Option<PilotMap>], showing: &[u32]) -> Option<Self> {
        let agreeing = |&map: &u32| {
            let of_map = maps[map as usize].as_ref()?;
            let (pixel, z) = of_map.camera.pixel(&self.place)?;
            let gsd = z / of_map.camera.focal[0];
            let is_kept = of_map.agrees_at(pixel, z)?;
            Some(Agreeing { map, gsd, is_kept })
        };
        self.maps = showing.iter().filter_map(agreeing).collect();
        (!self.maps.is_empty()).then_some(self)
    }

    fn cell(&self) -> Cell {
        let octave = octave(self.finest);
        let edge = EDGE * f64::from(octave).exp2();
        let position = [0, 1, 2].map(|axis| (self.place[axis] / edge).floor() as i64);
        Cell { octave, position }
    }
}

/// Cell of a place: its edge, as the exponent of a power of two, and its position in such edges.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct Cell {
    octave: i32,
    position: [i64; 3],
}

impl Cell {
    /// Returns how often the cells can be halved, by chance, until this one is left out.
    fn halvings(&self) -> u32 {
        let [x, y, z] = self.position.map(|at| at as u64);
        let numbers = [self.octave as u64, x, y, z];
        let mixed = numbers.into_iter().fold(0, |mixed: u64, number| {
            // An odd factor with bits all over, so that neighbours differ in the high bits.
            let product = (mixed ^ number).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            product ^ (product >> 32)
        });
        mixed.trailing_zeros()
    }
}

/// The cells that are places: all, or those that were left after some halvings. What is left does
/// not depend on when it was halved.
#[derive(Default)]
struct Sample {
    halvings: u32,
    taken: HashSet<Cell>,
    in_order: Vec<Cell>,
}

impl Sample {
    /// Returns whether the cell is one of the sample that is not taken yet.
    fn lacks(&self, cell: &Cell) -> bool {
        cell.halvings() >= self.halvings && !self.taken.contains(cell)
    }

    /// Takes the cell, if it is new and one of the sample; returns whether it is.
    fn takes(&mut self, cell: Cell) -> bool {
        let is_new = self.lacks(&cell);
        if is_new {
            self.taken.insert(cell);
            self.in_order.push(cell);
        }
        is_new
    }

    /// Removes about half of the cells; returns which are left, in the order of taking.
    fn halve(&mut self) -> Vec<bool> {
        self.halvings += 1;
        let is_left = |cell: &Cell| cell.halvings() >= self.halvings;
        let left = self.in_order.iter().map(is_left).collect();
        self.taken.retain(is_left);
        self.in_order.retain(is_left);
        left
    }
}

/// Removes what is not `sampled`.
fn retain<T>(list: &mut Vec<T>, sampled: &[bool]) {
    let mut sampled = sampled.iter();
    list.retain(|_| sampled.next().copied().unwrap_or(false));
    list.shrink_to_fit();
}

/// Returns the places of the sample that a map shows and that are not taken yet.
fn shown(maps: &[Option<PilotMap>], own: usize, others: &[u32], sample: &Sample) -> Vec<Shown> {
    let Some(map) = &maps[own] else {
        return Vec::new();
    };
    let is_looked_at = |pixel: usize| {
        let (x, y) = (pixel % map.camera.width, pixel / map.camera.width);
        x % STEP == STEP / 2 && y % STEP == STEP / 2
    };
    let places: Vec<Point3<f64>> = map
        .places()
        .filter(|(pixel, _)| is_looked_at(*pixel))
        .map(|(_, place)| place)
        .collect();
    let showing = [&[own as u32], others].concat();
    let look = |place: &Point3<f64>| {
        let found = Shown::new(maps, &showing, place)?;
        let found = Some(found).filter(|found| sample.lacks(&found.cell()));
        found?.with_agreeing(maps, &showing)
    };
    places.par_iter().filter_map(look).collect()
}

/// Returns for each map the others that show some of its places.
fn overlapping(maps: &[Option<PilotMap>]) -> Vec<Vec<u32>> {
    let probes = |map: &PilotMap| -> Vec<Point3<f64>> {
        // Of those that have a depth, however few.
        let places: Vec<Point3<f64>> = map.places().map(|(_, place)| place).collect();
        let step = (places.len() / PROBES).max(1);
        places.into_iter().step_by(step).collect()
    };
    let of_map = |(own, map): (usize, &Option<PilotMap>)| {
        let probes = map.as_ref().map(probes).unwrap_or_default();
        let shows_some = |&other: &u32| {
            other as usize != own
                && maps[other as usize].as_ref().is_some_and(|other| {
                    probes
                        .iter()
                        .any(|place| other.camera.pixel(place).is_some())
                })
        };
        (0..maps.len() as u32).filter(shows_some).collect()
    };
    maps.par_iter().enumerate().map(of_map).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::{super::Pinhole, *};
    use crate::{base::progress::NoWatcher, model::scene::Pose};

    /// A map of this size of a ground at z = 10, or without depths.
    fn map(width: usize, height: usize, inverse: f32) -> Option<PilotMap> {
        Some(PilotMap {
            camera: Pinhole {
                width,
                height,
                focal: [100.0; 2],
                centre: [50.0; 2],
                pose: Pose {
                    rotation: Rotation3::identity(),
                    translation: Vector3::zeros(),
                },
            },
            step: 1e-3,
            inverse: vec![inverse; width * height],
        })
    }

    #[test]
    fn a_map_has_as_many_places_alone_as_among_many() {
        let places = |maps: Vec<Option<PilotMap>>| {
            let cluster = |view| ViewCluster {
                key: ViewIndex(view),
                partners: Vec::new(),
            };
            let clusters: Vec<ViewCluster> = (0..maps.len() as u32).map(cluster).collect();
            Places::new(&clusters, maps, 1, 1.0, &NoWatcher).unwrap()
        };
        let alone = places(vec![map(100, 100, 0.1)]);
        let among_many = places(vec![map(100, 100, 0.1), map(10_000, 1_000, 0.0)]);
        assert!(alone.centres.len() > 1000);
        assert_eq!(among_many.centres, alone.centres);
    }

    fn cells() -> impl Iterator<Item = Cell> {
        let position = |n: i64| [n % 20, n / 20 % 20, n / 400];
        (0..4000).map(move |n| Cell {
            octave: -3,
            position: position(n),
        })
    }

    #[test]
    fn what_is_left_does_not_depend_on_when_it_was_halved() {
        let (mut early, mut late) = (Sample::default(), Sample::default());
        early.halve();
        for (n, cell) in cells().enumerate() {
            early.takes(cell);
            late.takes(cell);
            if n == 1000 {
                early.halve();
            }
        }
        assert_eq!(late.in_order.len(), 4000);
        let first = late.halve();
        let second = late.halve();
        assert_eq!(second.len(), first.iter().filter(|kept| **kept).count());
        assert!(early.in_order == late.in_order);
        let left = late.in_order.len();
        assert!((900..1100).contains(&left), "a quarter of 4000: {left}");
        assert!(!cells().any(|cell| late.takes(cell)), "none twice");
    }

    #[test]
    fn parts_stay_with_their_places() {
        let part = |place| Part {
            place,
            density: 1.0 + place as f32,
            kept: 1.0,
        };
        let mut places = Places {
            centres: (0..5)
                .map(|n| Point3::new(f64::from(n), 0.0, 0.0))
                .collect(),
            sizes: vec![1.0; 5],
            measured_area: vec![1.0; 5],
            agreement: vec![Agreement::More; 5],
            views: vec![ViewIndex(0), ViewIndex(1)],
            parts: vec![vec![part(0), part(1), part(4)], vec![part(2), part(3)]],
        };
        places.thin_out(&[false, true, false, true, true]);
        assert_eq!(places.sizes.len(), 3);
        let left: usize = places.parts.iter().map(Vec::len).sum();
        assert_eq!(left, 3);
        for part in places.parts.iter().flatten() {
            assert_eq!(
                1.0 + places.centres[part.place as usize].x as f32,
                part.density
            );
        }
    }
}
