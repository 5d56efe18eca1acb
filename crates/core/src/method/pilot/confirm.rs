//! Keeps of each pilot map what other maps confirm.

use nalgebra::Point3;
use rayon::prelude::*;

use super::sweep::PilotMap;
use crate::{
    base::progress::{Cancelled, Watcher},
    model::{cluster::ViewCluster, scene::ViewIndex},
};

/// Relative difference of two depths that agree; with more, clutter confirms itself.
const AGREE_WITHIN: f64 = 0.015;
/// The same in steps between planes: where the partners are near each other, [`AGREE_WITHIN`] is
/// less than the sweep can tell.
const PART_OF_A_PLANE: f64 = 0.25;
/// But no more than this: far behind the sparse points everything would agree.
const MOST_WITHIN: f64 = 0.03;
/// Part of that difference within which fusion is expected to keep a depth: OpenMVS fuses depths
/// that differ by at most 1 %.
const KEPT_WITHIN: f64 = 2.0 / 3.0;
/// Relative difference of the depths of neighbours on one surface.
const SAME_SURFACE: f32 = 0.03;
/// Neighbours, of eight, that must be on the same surface: single pixels are chance.
const LEAST_NEIGHBOURS: usize = 3;

impl PilotMap {
    /// Returns the places that the pixels with a confirmed depth show.
    pub(super) fn places(&self) -> impl Iterator<Item = (usize, Point3<f64>)> {
        let depths = self
            .inverse
            .iter()
            .enumerate()
            .filter(|(_, inverse)| **inverse > 0.0);
        depths.map(|(pixel, &inverse)| (pixel, self.camera.place(pixel, f64::from(inverse))))
    }

    /// Returns whether the map has the depth of a place.
    fn agrees(&self, place: &Point3<f64>) -> bool {
        let shown = self.camera.pixel(place);
        shown.is_some_and(|(pixel, z)| self.agrees_at(pixel, z).is_some())
    }

    /// Returns whether a pixel's depth is so near to this one that fusion keeps it; `None` if the
    /// two do not agree.
    pub(super) fn agrees_at(&self, pixel: usize, z: f64) -> Option<bool> {
        let inverse = f64::from(self.inverse[pixel]);
        // The difference of the inverse depths, relative to that of the place.
        let difference = (inverse * z - 1.0).abs();
        let tolerance = (PART_OF_A_PLANE * self.step * z).clamp(AGREE_WITHIN, MOST_WITHIN);
        (inverse > 0.0 && difference < tolerance).then_some(difference < KEPT_WITHIN * tolerance)
    }
}

/// Makes the depths negative that no map of a partner confirms, or that are alone. `maps`: one per
/// cluster, in the order of their key views.
pub fn confirm(
    clusters: &[ViewCluster],
    maps: &mut [Option<PilotMap>],
    watcher: &dyn Watcher,
) -> Result<(), Cancelled> {
    let map_of = |view: &ViewIndex| {
        let place = clusters
            .binary_search_by_key(view, |cluster| cluster.key)
            .ok()?;
        maps[place].as_ref()
    };
    let of_map = |(cluster, map): (&ViewCluster, &Option<PilotMap>)| {
        watcher.check()?;
        let Some(map) = map else { return Ok(None) };
        let others: Vec<&PilotMap> = cluster.partners.iter().filter_map(map_of).collect();
        let mut is_confirmed = vec![false; map.inverse.len()];
        for (pixel, place) in map.places() {
            is_confirmed[pixel] = others.iter().any(|other| other.agrees(&place));
        }
        Ok(Some(without_specks(map, &is_confirmed)))
    };
    let jobs = clusters.par_iter().zip(&*maps);
    let confirmed: Vec<Option<Vec<bool>>> = jobs.map(of_map).collect::<Result<_, Cancelled>>()?;
    // All maps are judged before any is changed: none may lose a depth because another has lost its
    // own.
    let jobs = maps.par_iter_mut().zip(confirmed);
    jobs.for_each(|(map, is_confirmed)| {
        let depths = map.iter_mut().flat_map(|map| &mut map.inverse);
        for (inverse, is_confirmed) in depths.zip(is_confirmed.into_iter().flatten()) {
            *inverse = if is_confirmed { *inverse } else { -*inverse };
        }
    });
    Ok(())
}

/// Takes all depths for confirmed ones.
pub fn take_all(maps: &mut [Option<PilotMap>]) {
    maps.par_iter_mut().flatten().for_each(|map| {
        let depths = map.inverse.iter_mut();
        depths.for_each(|inverse| *inverse = inverse.abs());
    });
}

/// Returns for each pixel whether it is confirmed, and not alone.
fn without_specks(map: &PilotMap, is_confirmed: &[bool]) -> Vec<bool> {
    let is_left = |pixel: usize| {
        is_confirmed[pixel] && confirmed_beside(map, is_confirmed, pixel) >= LEAST_NEIGHBOURS
    };
    (0..is_confirmed.len()).map(is_left).collect()
}

/// Returns the number of confirmed neighbours of a pixel that are on the same surface.
fn confirmed_beside(map: &PilotMap, is_confirmed: &[bool], pixel: usize) -> usize {
    let (width, height) = (map.camera.width as isize, map.camera.height as isize);
    let own = map.inverse[pixel];
    let (x, y) = (pixel as isize % width, pixel as isize / width);
    let around = (0..9).map(|i| (x + i % 3 - 1, y + i / 3 - 1));
    let beside = around.filter(|&(column, row)| {
        let inside = (0..width).contains(&column) && (0..height).contains(&row);
        let other = (row * width + column) as usize;
        inside
            && other != pixel
            && is_confirmed[other]
            && (map.inverse[other] - own).abs() < SAME_SURFACE * own
    });
    beside.count()
}
