//! What the ranking counts: the places that pilot maps show, or without a pilot the triangles of
//! the surface.

use std::sync::Arc;

use nalgebra::Point3;
use rayon::prelude::*;

use super::Tables;
use crate::{
    base::{
        kd_tree::KdTree,
        progress::{Cancelled, Watcher},
    },
    method::{
        confidence::Sharpness,
        fulfilment::FulfilmentTable,
        pilot::{Agreement, Part, Places},
        ranking::{Maps, Objective, Ranker, Ranking, Reached, TriangleWeight},
        region::Region,
    },
    model::{
        cluster::{MapScale, ViewCluster},
        scene::ViewIndex,
        surface::Surface,
    },
};

/// Part of the weight that the triangles keep beside the places, as predicted: it orders the maps
/// that add no place, and counts surface of which the pilot shows nothing.
const PREDICTED: f64 = 0.02;
/// The same for the order where fusion keeps what a single map shows, which the prediction knows as
/// well as the pilot does: with half of each, five sets are covered sooner than with either alone.
const PREDICTED_OF_SINGLE: f64 = 0.5;
/// Part of the places that a single map of the pilot shows in which fusion keeps something, by the
/// clouds of five sets: the others are chance.
const SINGLE_KEPT: f64 = 0.25;
/// Weight for the order of a place on which two maps agree: half of those are chance.
const TWO_FOR_ORDER: f64 = 0.5;

/// What the ranking counts with a pilot (method 5.9): the places, followed by the triangles, with
/// the part that each cluster of a plan has in them.
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
    pub half: Option<FulfilmentTable>,
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
    /// Ranks the maps at a price per unit of work ([`Ranker::rank`]), `ranker` by what decides on
    /// the order here.
    pub(super) fn rank(
        &self,
        ranker: &Ranker,
        finished: &[(u32, MapScale)],
        price: f64,
        watcher: &dyn Watcher,
    ) -> Result<Ranking, Cancelled> {
        let mut ranking = ranker.rank(finished, price, watcher)?;
        if self.pilot.is_some() {
            self.expect(&mut ranking);
        }
        Ok(ranking)
    }

    /// Replaces what a ranking keeps by its order with what fusion is expected to keep.
    fn expect(&self, ranking: &mut Ranking) {
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
        let nearest = nearest_triangles(&places.centres, rule.surface)?;
        let weighing = Weighing {
            places: &places,
            nearest: &nearest,
            rule,
        };
        let kept = kept_of_all(predicted.0, rule.objective);
        let order = weighing.order(kept);
        if kept == 0.0 || order.weights[..nearest.len()].iter().all(|&w| w == 0.0) {
            return None;
        }
        let counted = Self {
            by_area: weighing.by_area(),
            order: CountedBy::without_rows(order),
            kept: CountedBy::without_rows(weighing.kept(kept)),
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

    /// Returns the places and triangles that a finished map keeps for sure, ascending.
    pub fn surely_kept(&self, places: &[Part], triangles: &[u32]) -> Vec<u32> {
        let first = self.nearest.len() as u32;
        let is_sure = |part: &&Part| self.is_single() || part.kept == 1.0;
        let places = places.iter().filter(is_sure).map(|part| part.place);
        places.chain(triangles.iter().map(|&t| first + t)).collect()
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
        let f = |part: &Part| (part.place, worth * self.filled(part, what_for));
        let places = places.iter().map(f).filter(|(_, f)| *f > 0.0);
        let triangles = triangles.iter().zip(values).map(|(&t, &f)| (first + t, f));
        places.chain(triangles).collect()
    }

    /// Returns the share of a place's cells that a map fills, or that fusion keeps of it.
    fn filled(&self, part: &Part, what_for: For) -> f32 {
        let measured = FILLED * part.density * self.places.measured_area[part.place as usize];
        match what_for {
            _ if self.is_single() => measured.min(1.0),
            For::Order => (FILLED_FOR_ORDER * part.density).min(1.0),
            For::Kept => part.kept * measured.min(1.0),
        }
    }

    /// Returns the weights of what finished maps have shown, which is no longer a matter of
    /// chance ([`chance`](Self::chance)), with the same sum.
    pub fn measured(&self) -> Objective {
        let mut objective = self.kept.objective.clone();
        let sum: f64 = objective.weights.iter().sum();
        let weights = objective.weights.iter_mut().zip(0..);
        weights.for_each(|(weight, item)| *weight /= self.chance(item));
        let measured: f64 = objective.weights.iter().sum();
        if measured > sum {
            let factor = sum / measured;
            objective.weights.iter_mut().for_each(|w| *w *= factor);
        }
        objective
    }

    /// Returns the probability that fusion keeps something of what the pilot shows in this place;
    /// 1 for a triangle.
    pub fn chance(&self, item: u32) -> f64 {
        let agreement = self.places.agreement.get(item as usize);
        agreement.map_or(1.0, |&agreement| chance(agreement))
    }

    /// Returns whether fusion keeps what a single map shows, so that none need agree.
    fn is_single(&self) -> bool {
        self.kept.objective.support == 1
    }

    /// Returns the same with the parts of other clusters. `finished` returns what is measured of a
    /// view.
    pub fn of_clusters<'f>(
        &self,
        clusters: &[ViewCluster],
        (full, half): Predicted,
        finished: &dyn Fn(ViewIndex) -> Option<FinishedPart<'f>>,
    ) -> Self {
        let counted = |by: &CountedBy, what_for| {
            let table = |size, predicted| self.table(clusters, size, predicted, what_for, finished);
            CountedBy {
                objective: by.objective.clone(),
                table: table(MapScale::Full, full),
                half: half.map(|half| table(MapScale::Half, half)),
            }
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

    /// Returns f of places and triangles in maps of this size, by cluster.
    fn table<'f>(
        &self,
        clusters: &[ViewCluster],
        size: MapScale,
        predicted: &FulfilmentTable,
        what_for: For,
        finished: &dyn Fn(ViewIndex) -> Option<FinishedPart<'f>>,
    ) -> FulfilmentTable {
        let row = |(c, cluster): (usize, &ViewCluster)| {
            // At the other size, a finished map is not measured.
            let places = match finished(cluster.key) {
                Some((scale, places)) if scale == size => places,
                _ => self.places.of_view(cluster.key),
            };
            let row = self.row(places, size, predicted.row(c), what_for);
            self.weighed_by_sharpness(row, cluster.key, what_for)
        };
        FulfilmentTable::new(clusters.iter().enumerate().map(row))
    }

    /// Weighs the row of a map by the sharpness of its picture, which counts for the order alone.
    fn weighed_by_sharpness(
        &self,
        mut row: Vec<(u32, f32)>,
        key: ViewIndex,
        what_for: For,
    ) -> Vec<(u32, f32)> {
        if what_for == For::Order {
            let factor = self.sharpness.of(key).powf(SHARPNESS_FOR_ORDER) as f32;
            row.iter_mut().for_each(|(_, f)| *f *= factor);
        }
        row
    }
}

/// Returns the triangle nearest to each place; `None` for a surface without triangles.
fn nearest_triangles(places: &[Point3<f64>], surface: &Surface) -> Option<Vec<u32>> {
    if surface.triangles.is_empty() {
        return None;
    }
    let tree = KdTree::new(&surface.centroids());
    let nearest = places.par_iter().map(|place| tree.nearest::<1>(place)[0]);
    Some(nearest.collect())
}

/// Returns the weight that fusion keeps of all clusters, as predicted by triangle.
fn kept_of_all(predicted: &FulfilmentTable, objective: &Objective) -> f64 {
    let maps = Maps::full_size(predicted);
    let kept = Reached::by_all(&maps, objective).kept_weight();
    maps.release();
    kept
}

/// Makes objectives of places and triangles.
struct Weighing<'a> {
    places: &'a Places,
    /// Triangle nearest to each place.
    nearest: &'a [u32],
    rule: &'a PlacesRule<'a>,
}

impl Weighing<'_> {
    /// Returns the objective that decides on the order: places on which only two maps agree count
    /// less, those of single maps not at all.
    fn order(&self, sum: f64) -> Objective {
        let predicted = match self.rule.objective.support {
            1 => PREDICTED_OF_SINGLE,
            _ => PREDICTED,
        };
        let by_triangle = (self.rule.objective, predicted);
        self.objective(by_triangle, sum, |place| {
            // Chances of independent maps, more weight for a third map and a product with f all
            // gave worse orders in the clouds of OpenMVS on seven sets.
            let sure = match self.places.agreement[place] {
                Agreement::Single => 0.0,
                Agreement::Two => TWO_FOR_ORDER,
                Agreement::More => 1.0,
            };
            sure * self.by_setting(place)
        })
    }

    /// Returns the objective of what fusion is expected to keep.
    fn kept(&self, sum: f64) -> Objective {
        let by_triangle = (self.rule.objective, PREDICTED);
        self.objective(by_triangle, sum, |place| {
            chance(self.places.agreement[place]) * self.by_setting(place)
        })
    }

    fn by_area(&self) -> Objective {
        let rule = self.rule;
        let by_area = Objective::by_area(rule.surface, rule.region, rule.objective.support);
        self.objective((&by_area, PREDICTED), 1.0, |place| {
            chance(self.places.agreement[place]) * self.area(place)
        })
    }

    fn area(&self, place: usize) -> f64 {
        f64::from(self.places.sizes[place]).powi(2)
    }

    fn by_setting(&self, place: usize) -> f64 {
        match self.rule.weight {
            TriangleWeight::Area => self.area(place),
            _ => 1.0,
        }
    }

    /// Returns the factor of the region at a place.
    fn factor(&self, place: usize) -> f64 {
        let factors = self.rule.region.map(|region| &region.factors);
        factors.map_or(1.0, |factors| {
            f64::from(factors[self.nearest[place] as usize])
        })
    }

    /// Returns the objective that counts places by `weight`, followed by the triangles with the
    /// part `predicted` of theirs in `by_triangle`. `sum`: of both, where that of the triangles is
    /// 1.
    fn objective(
        &self,
        (by_triangle, predicted): (&Objective, f64),
        sum: f64,
        weight: impl Fn(usize) -> f64,
    ) -> Objective {
        let raw = (0..self.nearest.len()).map(|place| weight(place) * self.factor(place));
        let mut objective = Objective::weighing(raw.collect(), by_triangle.support);
        let weights = &mut objective.weights;
        weights
            .iter_mut()
            .for_each(|weight| *weight *= (1.0 - predicted) * sum);
        // Not times `sum`: of triangles with a total weight of 1, all clusters keep `sum`.
        weights.extend(by_triangle.weights.iter().map(|weight| predicted * weight));
        objective.inside = by_triangle.inside;
        objective
    }
}

/// Returns the probability that fusion keeps something where so many maps agree.
fn chance(agreement: Agreement) -> f64 {
    match agreement {
        Agreement::Single => SINGLE_KEPT,
        Agreement::Two | Agreement::More => 1.0,
    }
}

impl CountedBy {
    fn without_rows(objective: Objective) -> Self {
        Self {
            objective,
            table: FulfilmentTable::default(),
            half: None,
        }
    }

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
