//! What the ranking counts: the places on which pilot maps agree, or without a pilot the triangles
//! of the surface.

use std::sync::Arc;

use rayon::prelude::*;

use super::Tables;
use crate::{
    base::kd_tree::KdTree,
    method::{
        confidence::Sharpness,
        fulfilment::FulfilmentTable,
        pilot::{Part, Places},
        ranking::{Maps, Objective, Ranking, Reached, TriangleWeight},
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
    /// What decides on the order.
    order: CountedBy,
    /// What fusion is expected to keep: shares, area, and what is given up.
    pub kept: CountedBy,
    /// Weights of the latter by area.
    by_area: Objective,
    /// f of places in a map at half the size.
    half_worth: f32,
    sharpness: Sharpness,
}

/// Weights of places and triangles, and f of them by cluster, in the places in which its map takes
/// part, by the pilot or, where the cluster is finished, as measured.
#[derive(Clone, Debug)]
pub struct CountedBy {
    /// Weights that add up to what fusion keeps of the surface of all clusters, as far as that is
    /// predicted by triangle.
    pub objective: Objective,
    pub table: FulfilmentTable,
    /// f at half the size; `None` where all maps have full size.
    half: Option<FulfilmentTable>,
}

/// Cells of a place that a map fills, in pixels per wanted pixel: a place counts for the *order* as
/// soon as the map has a point within 2 g_d of each.
const FILLED_FOR_ORDER: f32 = 16.0;
/// *Kept* are as many cells, of those in which a cloud is measured, as have a point inside; by the
/// clouds of seven sets somewhat fewer than the four pixels of each.
const FILLED: f32 = 3.0;

/// What a row is made for.
#[derive(Clone, Copy, PartialEq, Eq)]
enum For {
    Order,
    Kept,
}

/// Power of a picture's sharpness by which a map counts for the order: it decides between maps that
/// give about the same.
const SHARPNESS_FOR_ORDER: f64 = 0.25;

/// A finished map: its size, and the places on which it agrees with the pilot.
pub type FinishedPart<'a> = (MapScale, &'a [Part]);

/// What a ranking counts.
#[derive(Clone, Copy)]
pub struct Counted<'a> {
    /// What decides on the order.
    pub objective: &'a Objective,
    pub maps: Maps<'a>,
    /// What fusion is expected to keep.
    pub kept: (&'a Objective, Maps<'a>),
    pilot: Option<&'a CountedPlaces>,
}

impl Counted<'_> {
    /// Replaces what a ranking keeps by its order with what fusion is expected to keep.
    pub(super) fn expect(&self, ranking: &mut Ranking) {
        if self.pilot.is_none() {
            return;
        }
        let (objective, maps) = self.kept;
        let mut reached = Reached::new(objective);
        let kept = ranking.maps().map(|(cluster, scale)| {
            reached.take(maps.row_at(cluster, scale));
            reached.kept_weight()
        });
        ranking.kept = kept.collect();
        ranking.reachable = Reached::by_all(&maps, objective).kept_weight();
    }

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
    pub sharpness: Sharpness,
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
            let weight = |place| of_place(place) * factor(place);
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
        let by_setting = |place: usize| match rule.weight {
            TriangleWeight::Area => size(place).powi(2),
            _ => 1.0,
        };
        let sure = |place: usize| places.weights[place] * by_setting(place);
        let [order, expected] = [&sure as &dyn Fn(usize) -> f64, &by_setting]
            .map(|of_place| weigh(rule.objective, of_place, kept));
        if kept == 0.0
            || order.weights[..nearest.len()]
                .iter()
                .all(|&weight| weight == 0.0)
        {
            return None;
        }
        let by = |objective| CountedBy {
            objective,
            table: FulfilmentTable::default(),
            half: None,
        };
        let counted = Self {
            by_area: weigh(&by_area, &|place| size(place).powi(2), 1.0),
            order: by(order),
            kept: by(expected),
            nearest: Arc::new(nearest),
            places,
            half_worth: rule.half_worth as f32,
            sharpness: rule.sharpness.clone(),
        };
        Some(counted.of_clusters(clusters, predicted, &|_| None))
    }

    /// Returns a row of what is kept: a map of this size, with its places and f of triangles.
    pub fn kept_row(
        &self,
        places: &[Part],
        size: MapScale,
        predicted: (&[u32], &[f32]),
    ) -> Vec<(u32, f32)> {
        self.row(places, size, predicted, For::Kept)
    }

    fn row(
        &self,
        places: &[Part],
        size: MapScale,
        (triangles, values): (&[u32], &[f32]),
        what_for: For,
    ) -> Vec<(u32, f32)> {
        let worth = match size {
            MapScale::Full => 1.0,
            MapScale::Half => self.half_worth,
        };
        let first = self.nearest.len() as u32;
        let filled = |part: &Part| match what_for {
            For::Order => FILLED_FOR_ORDER * part.density,
            For::Kept => FILLED * part.density * self.places.measured_area[part.place as usize],
        };
        let counts = |part: &&Part| what_for == For::Order || part.is_kept;
        let f = |part: &Part| (part.place, worth * filled(part).min(1.0));
        let places = places.iter().filter(counts).map(f);
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
        let row =
            |(c, cluster): (usize, &ViewCluster), size, predicted: &FulfilmentTable, what_for| {
                let places = match finished(cluster.key) {
                    Some((scale, places)) if scale == size => places,
                    _ => self.places.of_view(cluster.key),
                };
                let mut row = self.row(places, size, predicted.row(c), what_for);
                if what_for == For::Order {
                    let sharpness = self.sharpness.of(cluster.key);
                    let factor = sharpness.powf(SHARPNESS_FOR_ORDER) as f32;
                    row.iter_mut().for_each(|(_, f)| *f *= factor);
                }
                row
            };
        let table = |size, predicted, what_for| {
            let clusters = clusters.iter().enumerate();
            FulfilmentTable::new(clusters.map(|of| row(of, size, predicted, what_for)))
        };
        let counted = |by: &CountedBy, what_for| CountedBy {
            objective: by.objective.clone(),
            table: table(MapScale::Full, full, what_for),
            half: half.map(|half| table(MapScale::Half, half, what_for)),
        };
        Self {
            places: self.places.clone(),
            nearest: self.nearest.clone(),
            order: counted(&self.order, For::Order),
            kept: counted(&self.kept, For::Kept),
            by_area: self.by_area.clone(),
            half_worth: self.half_worth,
            sharpness: self.sharpness.clone(),
        }
    }
}

impl CountedBy {
    fn maps<'a>(&'a self, work: &'a [[f64; 2]]) -> Maps<'a> {
        match &self.half {
            None => Maps::full_size(&self.table),
            Some(half) => Maps::two_sizes(&self.table, half, work),
        }
    }
}

impl Tables {
    /// Returns what the ranking counts.
    pub fn counted(&self) -> Counted<'_> {
        match &self.pilot {
            None => Counted {
                objective: &self.objective,
                maps: self.maps(),
                kept: (&self.objective, self.maps()),
                pilot: None,
            },
            Some(pilot) => Counted {
                objective: &pilot.order.objective,
                maps: pilot.order.maps(&self.work),
                kept: (&pilot.kept.objective, pilot.kept.maps(&self.work)),
                pilot: Some(pilot),
            },
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
