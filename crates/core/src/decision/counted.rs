//! What the ranking counts: the places on which pilot maps agree, or without a pilot the triangles
//! of the surface.

use std::sync::Arc;

use rayon::prelude::*;

use super::Tables;
use crate::{
    base::kd_tree::KdTree,
    method::{
        fulfilment::FulfilmentTable,
        pilot::Places,
        ranking::{Maps, Objective, Reached, TriangleWeight},
        region::Region,
        surface::Surface,
    },
    model::{
        cluster::{MapScale, ViewCluster},
        scene::ViewIndex,
    },
};

/// Part of the weight that the triangles keep beside the places, as predicted: it orders the maps
/// that add no place, and counts surface of which the pilot shows nothing.
const PREDICTED: f64 = 0.02;

/// What the ranking counts with a pilot (method 5.9): the places, followed by the triangles, with the
/// part that each cluster of a plan has in them.
#[derive(Clone, Debug)]
pub struct CountedPlaces {
    pub places: Arc<Places>,
    /// Triangle nearest to each place.
    nearest: Arc<Vec<u32>>,
    /// Weights of places and triangles; they add up to the weight that fusion keeps of the surface of
    /// all clusters, as far as that is predicted by triangle.
    pub objective: Objective,
    /// The same by area.
    by_area: Objective,
    /// By cluster, f of places and triangles: [`Places::worth`] at the places in which its map takes
    /// part, by the pilot or, where the cluster is finished, as measured.
    pub table: FulfilmentTable,
    /// The same at half the size; `None` where all maps have full size.
    half: Option<FulfilmentTable>,
    /// f of places in a map at half the size.
    half_worth: f32,
}

/// A finished map: its size, and the places on which it agrees with the pilot, with their f at full
/// size.
pub type FinishedPart<'a> = (MapScale, &'a [(u32, f32)]);

/// What a ranking counts.
#[derive(Clone, Copy)]
pub struct Counted<'a> {
    pub objective: &'a Objective,
    pub maps: Maps<'a>,
    pilot: Option<&'a CountedPlaces>,
}

impl Counted<'_> {
    /// Returns the triangle of an item, or that nearest to a place.
    pub fn triangle(&self, item: u32) -> u32 {
        let Some(pilot) = self.pilot else {
            return item;
        };
        let places = pilot.nearest.len() as u32;
        match item.checked_sub(places) {
            Some(triangle) => triangle,
            None => pilot.nearest[item as usize],
        }
    }
}

/// What the weights of places are made with.
pub struct PlacesRule<'a> {
    pub surface: &'a Surface,
    pub region: Option<&'a Region>,
    /// The objective by triangle, and what it weighs.
    pub objective: &'a Objective,
    pub weight: TriangleWeight,
    /// f of a map at half the size.
    pub half_worth: f64,
}

/// Fulfilment of the triangles by the clusters of a plan, at full and at half size.
pub type Predicted<'a> = (&'a FulfilmentTable, Option<&'a FulfilmentTable>);

impl CountedPlaces {
    /// Weighs the places: those outside the region do not count. `None` if no place counts.
    pub fn new(
        places: Arc<Places>,
        clusters: &[ViewCluster],
        predicted: Predicted,
        rule: &PlacesRule,
    ) -> Option<Self> {
        let centroids: Vec<_> = (0..rule.surface.triangles.len() as u32)
            .map(|t| rule.surface.centroid(t))
            .collect();
        if centroids.is_empty() {
            return None;
        }
        let tree = KdTree::new(&centroids);
        let nearest = places
            .centres
            .par_iter()
            .map(|place| tree.nearest::<1>(place)[0]);
        let nearest: Vec<u32> = nearest.collect();
        let maps = Maps::full_size(predicted.0);
        let kept = Reached::by_all(&maps, rule.objective).kept_weight();
        maps.release();
        let by_area = Objective::by_area(rule.surface, rule.region, rule.objective.support);
        let size = |place: usize| f64::from(places.sizes[place]);
        let weigh = |by: &Objective, of_place: &dyn Fn(usize) -> f64, sum: f64| {
            let factor = |place: usize| {
                let factors = rule.region.map(|region| &region.factors);
                factors.map_or(1.0, |factors| f64::from(factors[nearest[place] as usize]))
            };
            let weight = |place| places.weights[place] * of_place(place) * factor(place);
            let raw = (0..nearest.len()).map(weight).collect();
            let mut weighed = Objective::weighing(raw, by.support);
            weighed
                .weights
                .iter_mut()
                .for_each(|weight| *weight *= (1.0 - PREDICTED) * sum);
            weighed
                .weights
                .extend(by.weights.iter().map(|weight| PREDICTED * weight));
            weighed.inside = by.inside;
            weighed
        };
        let of_place = |place: usize| match rule.weight {
            TriangleWeight::Area => size(place).powi(2),
            _ => 1.0,
        };
        let objective = weigh(rule.objective, &of_place, kept);
        if kept == 0.0
            || objective.weights[..nearest.len()]
                .iter()
                .all(|&weight| weight == 0.0)
        {
            return None;
        }
        let counted = Self {
            by_area: weigh(&by_area, &|place| size(place).powi(2), 1.0),
            objective,
            nearest: Arc::new(nearest),
            places,
            table: FulfilmentTable::default(),
            half: None,
            half_worth: rule.half_worth as f32,
        };
        Some(counted.of_clusters(clusters, predicted, &|_| None))
    }

    /// Returns a row of the table: places with their f at full size, for a map of this size, and f of
    /// triangles.
    pub fn row(
        &self,
        places: &[(u32, f32)],
        size: MapScale,
        (triangles, values): (&[u32], &[f32]),
    ) -> Vec<(u32, f32)> {
        let worth = match size {
            MapScale::Full => 1.0,
            MapScale::Half => self.half_worth,
        };
        let first = self.nearest.len() as u32;
        let places = places.iter().map(|&(place, f)| (place, f * worth));
        let triangles = triangles.iter().zip(values).map(|(&t, &f)| (first + t, f));
        places.chain(triangles).collect()
    }

    /// Returns the same with the parts of other clusters. `finished` returns what is measured of a
    /// view.
    pub fn of_clusters<'f>(
        &self,
        clusters: &[ViewCluster],
        (full, half): Predicted,
        finished: &dyn Fn(ViewIndex) -> Option<FinishedPart<'f>>,
    ) -> Self {
        let row = |(c, cluster): (usize, &ViewCluster), size, predicted: &FulfilmentTable| {
            let places = match finished(cluster.key) {
                Some((scale, places)) if scale == size => places,
                _ => self.places.of_view(cluster.key),
            };
            self.row(places, size, predicted.row(c))
        };
        let table = |size, predicted| {
            FulfilmentTable::new(
                clusters
                    .iter()
                    .enumerate()
                    .map(|of| row(of, size, predicted)),
            )
        };
        Self {
            table: table(MapScale::Full, full),
            half: half.map(|half| table(MapScale::Half, half)),
            ..self.clone()
        }
    }
}

impl Tables {
    /// Returns what the ranking counts.
    pub fn counted(&self) -> Counted<'_> {
        let Some(pilot) = &self.pilot else {
            return Counted {
                objective: &self.objective,
                maps: self.maps(),
                pilot: None,
            };
        };
        Counted {
            objective: &pilot.objective,
            maps: match &pilot.half {
                None => Maps::full_size(&pilot.table),
                Some(half) => Maps::two_sizes(&pilot.table, half, &self.work),
            },
            pilot: Some(pilot),
        }
    }

    /// Returns the objective that counts area.
    pub(super) fn counted_by_area(&self) -> Objective {
        match &self.pilot {
            Some(pilot) => pilot.by_area.clone(),
            None => Objective::by_area(&self.surface, self.region.as_ref(), self.objective.support),
        }
    }
}
