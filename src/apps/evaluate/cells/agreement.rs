//! A model of the fusion of depth maps: a point for each place on which maps agree.
//!
//! As OpenMVS fuses: maps in their order, each pixel that no earlier point has used; maps whose
//! depth at its place differs by at most one per cent join it, and their pixels are used. Unlike
//! there, normals and the program's list of neighbours are not asked.

use std::{ops::Range, sync::OnceLock};

use nalgebra::{Point2, Point3, Vector3};
use rayon::prelude::*;

use super::{
    CloudPart, FusedPoints, TakePart,
    frustum::{Frustum, Sphere},
};
use crate::{
    apps::evaluate::EvaluateError,
    base::progress::{Stage, Watcher},
    io::depthmaps::{self, DepthMap, DepthMapFile, DepthMapSet},
    model::{
        camera::Camera,
        scene::{Pose, Scene, ViewIndex},
    },
};

/// Relative difference of two depths that agree: the default of OpenMVS, COLMAP and PatchmatchNet.
const AGREE_WITHIN: f64 = 0.01;
/// Depths that are held at once; of more, every second, third, ... row and column counts.
const MOST_DEPTHS: u64 = 1 << 28;
/// Depths that are held of a map for each byte of its file, and of any map: what is packed closer
/// says little, and would cost as much as the largest images.
const DEPTHS_OF_BYTE: u64 = 8;
const DEPTHS_OF_ANY: u64 = 1 << 20;
/// Bytes of points that are kept once they are found; of more, all are found each time.
const MOST_KEPT: usize = 3 << 27;
/// Places of a map at which it is looked whether another shows the same, along each axis.
const PROBES: u32 = 12;

/// Side of the blocks of pixels for which the maps that may show them are listed.
const BLOCK: u32 = 16;

/// Depth maps, thinned to a bound of memory.
pub struct ThinnedMaps<'a> {
    maps: Vec<Thinned<'a>>,
    /// For each map, those that show some of its places.
    others: Vec<Vec<u32>>,
    /// Maps of a point that is kept.
    support: usize,
    /// The points, if they are few enough.
    points: OnceLock<Vec<CloudPart>>,
}

/// A point on which maps agree, with the maps and the pixels that made it.
struct AgreedPoint {
    mean: Point3<f64>,
    joined: Vec<(u32, usize)>,
}

/// Every n-th row and column of a depth map.
struct Thinned<'a> {
    camera: &'a Camera,
    pose: &'a Pose,
    frustum: Frustum,
    map: DepthMap,
}

impl<'a> ThinnedMaps<'a> {
    /// Reads the maps of these views.
    pub fn new(
        scene: &'a Scene,
        views: &[ViewIndex],
        maps: &DepthMapSet,
        support: u32,
        watcher: &dyn Watcher,
    ) -> Result<Self, EvaluateError> {
        let file = |view: &ViewIndex| maps.maps.iter().find(|map| map.view == *view);
        let files: Vec<_> = views.iter().filter_map(file).collect();
        watcher.progress(Stage::Evaluate, 0, files.len() as u64);
        let read = |file: &&DepthMapFile| {
            watcher.check()?;
            let map = depthmaps::read_of_view(file, scene)?;
            let camera = scene.camera_of(file.view);
            let pose = &scene.view(file.view).cam_from_world;
            Ok(Thinned {
                camera,
                pose,
                frustum: Frustum::new(camera, pose),
                // Thinned as it is read: the whole maps do not fit into memory together.
                map: thinned(map, most_depths(files.len(), file.data_bytes())),
            })
        };
        let maps: Vec<Thinned> = depthmaps::in_parallel::<_, _, EvaluateError>(
            &files,
            |file| Some(file.view),
            scene,
            read,
        )?;
        let others = (0..maps.len()).into_par_iter().map(|one| {
            let shows = |&other: &u32| {
                other as usize != one && maps[other as usize].shows_some_of(&maps[one])
            };
            (0..maps.len() as u32).filter(shows).collect()
        });
        Ok(Self {
            others: others.collect(),
            maps,
            support: support as usize,
            points: OnceLock::new(),
        })
    }

    /// Returns the points of the pixels of a map that no map before has used, and marks the pixels
    /// that make them as used.
    fn points_first_seen_by(&self, own: usize, used: &mut [Vec<bool>]) -> CloudPart {
        let rows = (0..self.maps[own].map.height.div_ceil(BLOCK)).into_par_iter();
        let points = rows.map(|row| self.points(own, row, used));
        // Found in parallel among pixels that earlier maps left, then taken in order: the same
        // cloud on any number of threads.
        let points: Vec<Vec<AgreedPoint>> = points.collect();
        let mut part = CloudPart::default();
        for AgreedPoint { mean, mut joined } in points.into_iter().flatten() {
            // Several pixels of this map may fall into one of a coarser map: the first has it.
            joined.retain(|&(map, pixel)| !used[map as usize][pixel]);
            if joined.len() < self.support {
                continue;
            }
            joined
                .iter()
                .for_each(|&(map, pixel)| used[map as usize][pixel] = true);
            part.push(mean, joined.into_iter().map(|(map, _)| map));
        }
        part.shrink_to_fit();
        part
    }

    /// Returns the points of a row of blocks of pixels, in the order of the pixels.
    fn points(&self, own: usize, row: u32, used: &[Vec<bool>]) -> Vec<AgreedPoint> {
        let (width, height) = (self.maps[own].map.width, self.maps[own].map.height);
        let rows = row * BLOCK..height.min((row + 1) * BLOCK);
        let others: Vec<Vec<u32>> = (0..width.div_ceil(BLOCK))
            .map(|block| {
                let columns = block * BLOCK..width.min((block + 1) * BLOCK);
                self.others_of_block(own, &rows, &columns)
            })
            .collect();
        let pixels = rows.start as usize * width as usize..rows.end as usize * width as usize;
        let point = |pixel: usize| {
            let block = pixel % width as usize / BLOCK as usize;
            self.point(own, pixel, &others[block], used)
        };
        pixels.filter_map(point).collect()
    }

    /// Returns the maps that may show a place of these pixels.
    fn others_of_block(&self, own: usize, rows: &Range<u32>, columns: &Range<u32>) -> Vec<u32> {
        let map = &self.maps[own];
        let pixels = rows.clone().flat_map(|row| {
            let start = row * map.map.width;
            columns.clone().map(move |column| start + column)
        });
        let places = pixels.filter_map(|pixel| map.place(pixel as usize));
        let Some(sphere) = Sphere::around(places) else {
            return Vec::new();
        };
        let may_show = |other: &u32| self.maps[*other as usize].frustum.may_see(&sphere);
        let others = self.others[own].iter().copied();
        others.filter(may_show).collect()
    }

    /// Returns the point of a pixel; `None` if it is used, or too few maps agree. `others`: the
    /// maps that may show its place.
    fn point(
        &self,
        own: usize,
        pixel: usize,
        others: &[u32],
        used: &[Vec<bool>],
    ) -> Option<AgreedPoint> {
        let map = &self.maps[own];
        if used[own][pixel] {
            return None;
        }
        let first = map.place(pixel)?;
        let mut sum = first.coords;
        let mut joined = vec![(own as u32, pixel)];
        for &other in others {
            if let Some((pixel, place)) = self.maps[other as usize].agrees(&first)
                && !used[other as usize][pixel]
            {
                sum += place;
                joined.push((other, pixel));
            }
        }
        (joined.len() >= self.support).then(|| AgreedPoint {
            mean: Point3::from(sum / joined.len() as f64),
            joined,
        })
    }
}

impl Thinned<'_> {
    fn position(&self, pixel: usize) -> Point2<f64> {
        let (column, row) = (pixel as u32 % self.map.width, pixel as u32 / self.map.width);
        self.map.image_position(self.camera, column, row)
    }

    /// Returns the place that a pixel measured.
    fn place(&self, pixel: usize) -> Option<Point3<f64>> {
        let z = f64::from(self.map.depth[pixel]);
        let ray = (z > 0.0)
            .then(|| self.camera.ray(&self.position(pixel)))
            .flatten()?;
        // Depths are along the axis, not along the ray.
        (ray.z > 0.0).then(|| self.world(ray.into_inner() * (z / ray.z)))
    }

    fn world(&self, x: Vector3<f64>) -> Point3<f64> {
        Point3::from(self.pose.rotation.inverse() * (x - self.pose.translation))
    }

    /// Returns the pixel that shows the place if its depth agrees, and the place that it measured
    /// along the ray of the place.
    fn agrees(&self, place: &Point3<f64>) -> Option<(usize, Vector3<f64>)> {
        let x = self.pose.camera_from_world(place);
        let at = (x.z > 0.0).then(|| self.camera.project(&x)).flatten()?;
        let (column, row) = self.map.pixel_at(self.camera, &at)?;
        let z = self.map.depth_at(column, row)?;
        let agrees = (z - x.z).abs() <= AGREE_WITHIN * x.z;
        let pixel = row as usize * self.map.width as usize + column as usize;
        agrees.then(|| (pixel, self.world(x.coords * (z / x.z)).coords))
    }

    fn shows_some_of(&self, other: &Thinned) -> bool {
        let (width, height) = (other.map.width, other.map.height);
        let probe = |i: u32, length: u32| (2 * i + 1) * length / (2 * PROBES);
        let mut probes = (0..PROBES * PROBES)
            .map(|i| (probe(i % PROBES, width), probe(i / PROBES, height)))
            .filter_map(|(column, row)| other.place((row * width + column) as usize));
        probes.any(|place| {
            let x = self.pose.camera_from_world(&place);
            let at = (x.z > 0.0).then(|| self.camera.project(&x)).flatten();
            at.is_some_and(|at| self.camera.contains(&at))
        })
    }
}

/// Limit on the depths held in memory for each of `maps` maps; `file_bytes`: size of its file.
fn most_depths(maps: usize, file_bytes: u64) -> u64 {
    let of_file = file_bytes.saturating_mul(DEPTHS_OF_BYTE);
    (MOST_DEPTHS / maps.max(1) as u64).min(of_file.max(DEPTHS_OF_ANY))
}

/// Keeps every n-th row and column, so that at most about `most` depths are left.
fn thinned(map: DepthMap, most: u64) -> DepthMap {
    let step = (1u32..).find(|step| {
        u64::from(map.width.div_ceil(*step)) * u64::from(map.height.div_ceil(*step)) <= most.max(1)
    });
    let step = step.unwrap_or(u32::MAX);
    if step == 1 {
        return map;
    }
    // At least one of each.
    let middle = |side: u32| (step / 2).min(side - 1);
    let rows = (middle(map.height)..map.height).step_by(step as usize);
    let columns = |row: u32| {
        (middle(map.width)..map.width)
            .step_by(step as usize)
            .map(move |column| (row, column))
    };
    let depth_at =
        |(row, column): (u32, u32)| map.depth[row as usize * map.width as usize + column as usize];
    let depth: Vec<f32> = rows.clone().flat_map(columns).map(depth_at).collect();
    let height = rows.len() as u32;
    DepthMap {
        width: depth.len() as u32 / height.max(1),
        height,
        depth,
        ..map
    }
}

impl FusedPoints for ThinnedMaps<'_> {
    fn for_each_part(&self, take: &mut TakePart) -> Result<(), EvaluateError> {
        if let Some(parts) = self.points.get() {
            return parts.iter().try_for_each(take);
        }
        let mut used: Vec<Vec<bool>> = self
            .maps
            .iter()
            .map(|map| vec![false; map.map.depth.len()])
            .collect();
        let may_agree = |own: &usize| 1 + self.others[*own].len() >= self.support;
        let (mut parts, mut bytes) = (Vec::new(), 0);
        for own in (0..self.maps.len()).filter(may_agree) {
            let part = self.points_first_seen_by(own, &mut used);
            take(&part)?;
            bytes += part.bytes();
            if bytes <= MOST_KEPT {
                parts.push(part);
            } else {
                // The first ones alone would be of no use: all have to be found again anyway.
                parts.clear();
            }
        }
        if bytes <= MOST_KEPT {
            self.points.set(parts).ok();
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_are_held_whole_unless_their_files_say_little() {
        let phase_one = 14_204 * 10_652;
        for bytes in [4 * phase_one, phase_one / 2, u64::MAX] {
            assert!(most_depths(1, bytes) >= phase_one, "{bytes}");
        }
        assert!(most_depths(1, 400_000) < phase_one / 8);
        assert_eq!(most_depths(1, 0), DEPTHS_OF_ANY);
        assert!(100 * most_depths(100, u64::MAX) <= MOST_DEPTHS);
    }
}
