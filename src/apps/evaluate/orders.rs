//! Orders of view clusters to compare with the plan's (method 8), all of the same clusters.

use nalgebra::{Point3, Vector3};
use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64;

use super::run::MeasuredClusters;
use crate::{
    base::{column::TableError, progress::Watcher},
    method::{
        fulfilment::FulfilmentTable,
        ranking::{Beliefs, Objective, Reached, rank},
    },
    model::{cluster::ViewCluster, scene::Scene},
    plan::Plan,
};

/// Number of random orders.
pub const RANDOM_SEEDS: u64 = 20;

/// Returns the greedy order by a table, followed by the clusters that add nothing, by index; each
/// cluster appears once.
pub fn greedy(
    table: &FulfilmentTable,
    objective: &Objective,
    watcher: &dyn Watcher,
) -> Result<Vec<u32>, TableError> {
    Ok(completed(
        rank(table, objective, watcher)?.order,
        table.clusters(),
    ))
}

/// Returns the order with the remaining clusters appended by index.
pub fn completed(order: Vec<u32>, clusters: usize) -> Vec<u32> {
    let mut taken = vec![false; clusters];
    order.iter().for_each(|&c| taken[c as usize] = true);
    let rest = (0..clusters as u32).filter(|&c| !taken[c as usize]);
    order.iter().copied().chain(rest).collect()
}

/// Returns all clusters of a plan in rank order, those without predicted gain last.
pub fn of_plan(plan: &Plan) -> impl Iterator<Item = &ViewCluster> {
    let clusters = &plan.stages.clusters;
    let order = completed(plan.decision.ranking.order.clone(), clusters.len());
    order.into_iter().map(|c| &clusters[c as usize])
}

/// Returns the order `realupdate`: next comes the cluster with the largest predicted gain over what
/// was really reached so far.
pub fn real_update(
    predicted: &FulfilmentTable,
    real: &FulfilmentTable,
    objective: &Objective,
) -> Vec<u32> {
    best_first(
        predicted.clusters(),
        Reached::new(objective),
        |reached, c| reached.gain(predicted.row(c)),
        |reached, c| reached.take(real.row(c)),
    )
}

/// Returns the order in which always the cluster with the largest `gain` is taken next, the first
/// of equals. Both work on the state.
fn best_first<S>(
    clusters: usize,
    mut state: S,
    gain: impl Fn(&S, usize) -> f64,
    take: impl Fn(&mut S, usize),
) -> Vec<u32> {
    let mut left: Vec<u32> = (0..clusters as u32).collect();
    let mut order = Vec::with_capacity(clusters);
    while !left.is_empty() {
        let gains = left.iter().map(|&c| gain(&state, c as usize));
        // Not `swap_remove`: the order of the rest decides ties.
        let cluster = left.remove(first_largest(gains));
        take(&mut state, cluster as usize);
        order.push(cluster);
    }
    order
}

/// Returns the order `replan` (method 5.4): as `realupdate`, but failures also lower later
/// predictions. `beliefs`: those of the run's clusters.
pub fn replan(beliefs: Beliefs, run: &MeasuredClusters, objective: &Objective) -> Vec<u32> {
    best_first(
        run.clusters.len(),
        (beliefs, Reached::new(objective)),
        |(beliefs, reached), c| {
            let (triangles, believed) = beliefs.row(c);
            reached.gain((triangles, &believed))
        },
        |(beliefs, reached), c| {
            reached.take(run.real.row(c));
            beliefs.learn(run.clusters[c].key, &run.attempts[c]);
        },
    )
}

/// Returns the order `maxpts`: next comes the key view that observes the most sparse points not yet
/// observed by a chosen one; ties by index.
pub fn max_points(scene: &Scene, clusters: &[ViewCluster]) -> Vec<u32> {
    let points = scene.view_points();
    let cluster_of = scene.places_of(clusters.iter().map(|cluster| cluster.key));
    let uncovered: Vec<usize> = clusters
        .iter()
        .map(|c| points.observed_by(c.key).len())
        .collect();
    let covered = vec![false; scene.points.len()];
    best_first(
        clusters.len(),
        (uncovered, covered),
        |(uncovered, _), c| uncovered[c] as f64,
        |(uncovered, covered), c| {
            for &point in points.observed_by(clusters[c].key) {
                if std::mem::replace(&mut covered[point.index()], true) {
                    continue;
                }
                let mut last = None;
                for &view in scene.track_views(point) {
                    // A view that observes the point twice counts once.
                    if last.replace(view) != Some(view)
                        && let Some(c) = cluster_of[view.index()]
                    {
                        uncovered[c] -= 1;
                    }
                }
            }
        },
    )
}

/// Returns the choice `every n-th`: `count` of `clusters`, evenly spread by name. Choices of
/// different counts are not nested.
pub fn every_nth(clusters: usize, count: usize) -> Vec<u32> {
    (0..count)
        .map(|i| ((2 * i + 1) * clusters / (2 * count)) as u32)
        .collect()
}

/// Returns the order `farthest view`: first the key view nearest to the centroid, then always the
/// one farthest from all those taken; ties by index.
pub fn farthest_view(scene: &Scene, clusters: &[ViewCluster]) -> Vec<u32> {
    let centres: Vec<Point3<f64>> = clusters
        .iter()
        .map(|c| scene.view(c.key).cam_from_world.centre())
        .collect();
    let middle = centres
        .iter()
        .fold(Vector3::zeros(), |sum, c| sum + c.coords)
        / centres.len().max(1) as f64;
    let mut order = Vec::with_capacity(centres.len());
    // First: nearness to the middle. Later: distance from the nearest taken one, -1 where taken.
    let mut distance: Vec<f64> = centres
        .iter()
        .map(|c| -(c.coords - middle).norm())
        .collect();
    while order.len() < centres.len() {
        let next = first_largest(distance.iter().copied());
        let is_first = order.is_empty();
        for (own, centre) in distance.iter_mut().zip(&centres) {
            let added = (centre - centres[next]).norm();
            *own = if is_first { added } else { own.min(added) };
        }
        distance[next] = -1.0;
        order.push(next as u32);
    }
    order
}

/// Returns a random order.
pub fn random(clusters: usize, seed: u64) -> Vec<u32> {
    let mut order: Vec<u32> = (0..clusters as u32).collect();
    shuffle(&mut order, seed);
    order
}

/// Shuffles the values (Fisher-Yates).
pub fn shuffle<T>(values: &mut [T], seed: u64) {
    let mut generator = Pcg64::seed_from_u64(seed);
    for i in (1..values.len()).rev() {
        // The bias is at most one part in 2^64 / below: too small to draw again.
        let below = i as u128 + 1;
        values.swap(
            i,
            ((u128::from(generator.next_u64()) * below) >> 64) as usize,
        );
    }
}

/// Returns the position of the largest value, the first one in a tie.
fn first_largest(values: impl Iterator<Item = f64>) -> usize {
    values
        .enumerate()
        .fold(
            (0, f64::NEG_INFINITY),
            |best, v| if v.1 > best.1 { v } else { best },
        )
        .0
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;
    use crate::{
        base::progress::NoWatcher,
        model::scene::{CameraIndex, Pose, View, ViewIndex},
    };

    fn table(rows: &[&[(u32, f32)]]) -> FulfilmentTable {
        FulfilmentTable::new(rows)
    }

    fn even() -> Objective {
        Objective::weighing(vec![1.0; 2], 1)
    }

    #[test]
    fn the_farthest_view_is_next() {
        let mut scene = scene(&[&[0], &[0], &[0], &[0], &[0]]);
        for (view, x) in scene.views.iter_mut().zip([0.0, 1.0, 2.0, 4.0, 10.0]) {
            view.cam_from_world.translation.x = -x;
        }
        let clusters: Vec<_> = (0..5)
            .map(|v| ViewCluster {
                key: ViewIndex(v),
                partners: Vec::new(),
            })
            .collect();
        // The middle is at 3.4.
        assert_eq!(farthest_view(&scene, &clusters), [3, 4, 0, 2, 1]);
        assert!(farthest_view(&scene, &[]).is_empty());
    }

    #[test]
    fn greedy_ends_with_what_adds_nothing() {
        let table = table(&[&[(0, 0.5)], &[], &[(0, 1.0), (1, 0.1)], &[(0, 0.9)]]);
        assert_eq!(greedy(&table, &even(), &NoWatcher).unwrap(), [2, 0, 1, 3]);
    }

    #[test]
    fn real_update_looks_at_what_really_came_of_the_clusters_taken() {
        // Cluster 0 promises everything and fails; its neighbour 1 promises the same, 2 less
        // elsewhere.
        let predicted = table(&[&[(0, 0.9)], &[(0, 0.8)], &[(1, 0.5)]]);
        let real = table(&[&[], &[(0, 0.8)], &[(1, 0.5)]]);
        assert_eq!(real_update(&predicted, &real, &even()), [0, 1, 2]);
        assert_eq!(real_update(&predicted, &predicted, &even()), [0, 2, 1]);
    }

    /// Views that observe the points of each list.
    fn scene(observed: &[&[u32]]) -> Scene {
        let cam_from_world = Pose {
            rotation: Rotation3::identity(),
            translation: Vector3::zeros(),
        };
        let view = |i: usize| View {
            name: format!("{i}"),
            image_id: 0,
            file_position: 0,
            camera: CameraIndex(0),
            cam_from_world,
        };
        let mut scene = Scene {
            views: (0..observed.len()).map(view).collect(),
            track_offsets: vec![0],
            ..Default::default()
        };
        for point in 0..=observed
            .iter()
            .flat_map(|o| o.iter())
            .copied()
            .max()
            .unwrap()
        {
            scene.points.push(Point3::origin());
            let views = (0..observed.len()).filter(|&v| observed[v].contains(&point));
            // Twice each: a view may observe a point twice.
            scene
                .track_views
                .extend(views.flat_map(|v| [ViewIndex(v as u32); 2]));
            scene.track_offsets.push(scene.track_views.len());
        }
        scene
    }

    #[test]
    fn max_points_removes_what_is_covered() {
        let scene = scene(&[&[0, 1, 2], &[0, 1, 2, 3], &[4, 5], &[3, 4, 6]]);
        let clusters: Vec<_> = (0..4)
            .map(|v| ViewCluster {
                key: ViewIndex(v),
                partners: Vec::new(),
            })
            .collect();
        // View 1 has most; then 2 and 3 have two each; then 3 or 2 has one left, 0 none.
        assert_eq!(max_points(&scene, &clusters), [1, 2, 3, 0]);
        assert_eq!(max_points(&scene, &clusters[2..]), [1, 0]);
    }

    #[test]
    fn every_nth_is_spread_evenly() {
        assert_eq!(every_nth(10, 5), [1, 3, 5, 7, 9]);
        assert_eq!(every_nth(10, 10), (0..10).collect::<Vec<_>>());
        assert_eq!(every_nth(7, 1), [3]);
        assert!((1..=111).all(|n| every_nth(111, n).windows(2).all(|w| w[0] < w[1])));
    }

    #[test]
    fn random_orders_are_permutations_that_the_seed_decides() {
        let mut sorted = random(50, 7);
        assert_eq!(sorted, random(50, 7));
        assert_ne!(sorted, random(50, 8));
        sorted.sort_unstable();
        assert_eq!(sorted, (0..50).collect::<Vec<_>>());
    }
}
