//! The choice of partners on the synthetic town.

use super::{candidates::candidates, *};
use crate::{
    base::{column::Storage, progress::NoWatcher},
    method::{
        confidence::{Confidence, NO_AGREEMENT, PairConfidence, Unary},
        fulfilment::{self, FulfilmentRule},
        synthetic::{SeenTown, Town},
        target::{Target, TargetSettings},
        visibility::Visibility,
    },
    model::{
        cluster::{Gate, ViewCluster},
        scene::Scene,
        surface::Surface,
    },
};

/// That of a program which rectifies pairs of images.
const GATE: Gate = Gate {
    min_shared_points: 1,
    min_angle_deg: 1.0,
    max_angle_deg: 60.0,
    max_scale_octaves: 0.7655,
    epipole_inside: false,
};

struct Setting {
    scene: Scene,
    surface: Surface,
    visibility: Visibility,
    target: Target,
    unary: Unary,
    candidates: Candidates,
}

impl Setting {
    fn new() -> Self {
        Self::kept(Storage::Memory)
    }

    fn kept(keep: Storage) -> Self {
        let town = Town {
            edge: 3.0,
            points: 300,
            ..Town::default()
        };
        let SeenTown {
            scene,
            surface,
            visibility,
            mut target,
        } = town.seen(&TargetSettings::default(), 0.05, keep);
        let points = scene.view_points();
        target.accuracy_over_gsd = 0.4;
        let candidates = candidates(
            &scene,
            &points,
            &PartnerSettings::default(),
            &Limits::gate(&GATE),
            &NoWatcher,
        )
        .unwrap();
        Self {
            scene,
            surface,
            visibility,
            target,
            unary: Unary::certain(),
            candidates,
        }
    }

    fn model(&self) -> Model<'_> {
        let numbers = PairConfidence {
            min_matches: 2,
            p0: 0.8,
            cosine_power: 1.0,
            scale_octaves: Some(0.7),
            full_angle_deg: None,
        };
        let confidence = Confidence::Pair(numbers);
        let rule = FulfilmentRule {
            alpha: 0.5,
            sigma_px: 0.5,
            min_cameras: 3,
            image_scale: 1.0,
            confidence,
        };
        let Self {
            scene,
            surface,
            visibility,
            target,
            unary,
            ..
        } = self;
        Model {
            scene,
            surface,
            visibility,
            target,
            unary,
            agreement: &NO_AGREEMENT,
            rule,
        }
    }

    fn choose(&self, settings: &PartnerSettings) -> (Vec<ViewCluster>, FulfilmentTable) {
        choose(&self.model(), &self.candidates, settings, 0, &NoWatcher).unwrap()
    }
}

#[test]
fn tables_on_disk_hold_what_tables_in_memory_hold() {
    let [mut memory, mut disk] = [Storage::Memory, Storage::Disk].map(Setting::kept);
    for setting in [&mut memory, &mut disk] {
        let points = setting.scene.view_points();
        let Setting {
            scene,
            surface,
            visibility,
            ..
        } = &*setting;
        setting.unary =
            crate::method::confidence::nearby(scene, &points, surface, visibility, &NoWatcher)
                .unwrap();
    }
    assert_eq!(
        (&disk.visibility, &disk.unary),
        (&memory.visibility, &memory.unary)
    );
    let settings = settings(3, PartnerMethod::Search);
    let (chosen, expected) = (disk.choose(&settings), memory.choose(&settings));
    assert_eq!(chosen, expected);
    let kept = |s: &Setting, t: &FulfilmentTable| {
        [&s.visibility.triangles, &t.triangles].map(|column| column.storage())
    };
    assert_eq!(kept(&disk, &chosen.1), [Storage::Disk; 2]);
    assert_eq!(kept(&memory, &expected.1), [Storage::Memory; 2]);
    let triangles = 0..disk.surface.triangles.len();
    let keep: Vec<bool> = triangles.map(|triangle| triangle % 3 != 1).collect();
    let shared = memory.visibility.clone();
    let in_copies = shared.keep(&keep).unwrap();
    assert!(in_copies.triangles.len() < memory.visibility.triangles.len());
    assert_eq!(disk.visibility.keep(&keep).unwrap(), in_copies);
    assert_eq!(
        memory.visibility.keep(&keep).unwrap(),
        in_copies,
        "in place"
    );
}

fn settings(k: u32, method: PartnerMethod) -> PartnerSettings {
    PartnerSettings {
        k,
        method,
        ..Default::default()
    }
}

fn sum(table: &FulfilmentTable, cluster: usize) -> f64 {
    table.row(cluster).1.iter().map(|&f| f64::from(f)).sum()
}

#[test]
fn search_is_never_below_sampled() {
    let setting = Setting::new();
    let mut better = 0;
    for k in [1, 2, 3, 5, 11] {
        let (clusters, sampled) = setting.choose(&settings(k, PartnerMethod::Sampled));
        let (_, searched) = setting.choose(&settings(k, PartnerMethod::Search));
        for (c, cluster) in clusters.iter().enumerate() {
            assert!(sum(&searched, c) >= sum(&sampled, c), "{cluster:?}");
            better += u32::from(sum(&searched, c) > sum(&sampled, c));
        }
    }
    assert!(better > 0);
}

/// With few candidates `sampled` goes through all sets: nothing is better, and `search` stays
/// there.
#[test]
fn sampled_is_the_optimum_where_it_takes_all() {
    let mut setting = Setting::new();
    let few = PartnerSettings {
        candidates: 6,
        ..Default::default()
    };
    setting.candidates = candidates(
        &setting.scene,
        &setting.scene.view_points(),
        &few,
        &Limits::gate(&GATE),
        &NoWatcher,
    )
    .unwrap();
    let all_judge = PartnerSettings {
        triangle_fraction: 1,
        ..settings(3, PartnerMethod::Sampled)
    };
    let (clusters, table) = setting.choose(&all_judge);
    let (_, searched) = setting.choose(&PartnerSettings {
        method: PartnerMethod::Search,
        ..all_judge
    });
    for (c, cluster) in clusters.iter().enumerate().step_by(7) {
        let of = setting.candidates.candidates_of(cluster.key);
        let sets = (0..64u32).filter(|s| s.count_ones() == 3);
        let every: Vec<ViewCluster> = sets
            .map(|s| ViewCluster {
                key: cluster.key,
                partners: (0..6).filter(|i| s >> i & 1 == 1).map(|i| of[i]).collect(),
            })
            .collect();
        let exhaustive = fulfilment::table(&setting.model(), &every, &NoWatcher).unwrap();
        let optimum = (0..every.len())
            .map(|e| sum(&exhaustive, e))
            .fold(0.0, f64::max);
        assert!((sum(&table, c) - optimum).abs() <= 1e-6 * optimum);
        assert!((sum(&searched, c) - optimum).abs() <= 1e-6 * optimum);
    }
}

/// Greedy addition takes the largest gain each time, and the search ends where no exchange of one
/// partner gains. All triangles judge here.
#[test]
fn the_search_takes_what_gains_most() {
    let setting = Setting::new();
    let model = setting.model();
    let (mut slots, k, mut exchanged) = (BlockSlots::new(&model), 3, 0);
    let has_choice = |key: &ViewIndex| setting.candidates.candidates_of(*key).len() > k;
    for key in setting.scene.view_indices().filter(has_choice).step_by(3) {
        let partners = setting.candidates.candidates_of(key);
        let mut block = Block::new(&model, key, partners, |_| true, &mut slots);
        let (n, judges) = (partners.len(), search::judges(&block));
        let total = |block: &mut Block, set: &[usize]| PartnerChoice::new(block, set.to_vec()).sum;
        let greedy = search::greedy(&mut block, n, k, judges);
        for length in 0..k {
            let others = (0..n).filter(|p| !greedy[..length].contains(p));
            let best = others
                .map(|p| total(&mut block, &[&greedy[..length], &[p]].concat()))
                .fold(0.0, f64::max);
            let taken = total(&mut block, &greedy[..=length]);
            assert!(taken >= best * (1.0 - 1e-5), "{key:?}: {taken} {best}");
        }
        let found = search::search(&mut block, (n - k..n).collect(), n);
        assert!(found.sum >= total(&mut block, &greedy));
        for (out, p) in (0..k)
            .flat_map(|out| (0..n).map(move |p| (out, p)))
            .filter(|(_, p)| !found.partners.contains(p))
        {
            let mut set = found.partners.clone();
            set[out] = p;
            let other = total(&mut block, &set);
            assert!(
                other <= found.sum * (1.0 + 1e-5),
                "{key:?}: {other} {}",
                found.sum
            );
        }
        exchanged += u32::from(!greedy.iter().all(|p| found.partners.contains(p)));
    }
    assert!(exchanged > 0);
}

#[test]
fn the_table_is_that_of_the_clusters() {
    let setting = Setting::new();
    for method in [PartnerMethod::Sampled, PartnerMethod::Search] {
        let (clusters, table) = setting.choose(&settings(4, method));
        assert!(
            clusters
                .iter()
                .all(|c| c.partners.len() == 4.min(setting.candidates.candidates_of(c.key).len()))
        );
        let again = fulfilment::table(&setting.model(), &clusters, &NoWatcher).unwrap();
        assert_eq!(
            (&table.offsets, &table.triangles),
            (&again.offsets, &again.triangles)
        );
        // Partners are added up in another order.
        assert!(
            table
                .values
                .iter()
                .zip(&*again.values)
                .all(|(a, b)| (a - b).abs() <= 1e-6 * b)
        );
    }
}

#[test]
fn threads_do_not_matter() {
    let setting = Setting::new();
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| setting.choose(&settings(3, PartnerMethod::Search)))
    };
    assert_eq!(with(1), with(16));
}
