//! Trains the confidence on finished depth maps (method 7.3): labels, the picture classifier, and the curves of pairs and places.
//!
//! Stages that are fitted to the output of an earlier trained stage (calibration; curves of the picture's prediction) get out-of-sample
//! predictions: one of the [`Parts`] is predicted by a model trained on the others.

use std::sync::atomic::{AtomicU64, Ordering};

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

mod fit;
mod grow;
mod labels;
mod parts;
mod score;

pub use self::labels::Label;
use self::{
    fit::{FittedCurves, PairRow, TrainingRow},
    grow::Boosting,
    labels::{LabelledMap, Labelling},
    parts::{Parts, Views},
    score::Scores,
};
use crate::method::confidence::{
    ConfidenceMap, Constellation, Unary,
    features::{self, Features},
    image::{Image, size_for_confidence},
    place::{self, PlaceFeatures},
    trained::{PictureModel, TrainedModel, TrainedOn, VERSION, ValidationScores},
    trees::{BINS, Table},
};
use crate::{
    base::{
        column::TableError,
        error::Hint,
        progress::{Cancelled, Stage, Watcher},
    },
    io::{
        depthmaps::{self, DepthMapError, DepthMapFile},
        project::ImageFolder,
    },
    method::{fulfilment::Model, partners::Candidates},
    model::{cluster::ViewCluster, scene::ViewIndex},
};

/// Limits on the pixels and triangles to train on.
const MOST_PIXELS: usize = 100_000;
const MOST_TRIANGLES: usize = 40_000;
/// Limit per image.
const MOST_PER_IMAGE: usize = 2000;
/// Judged pixels from which a triangle has full weight.
const FULL_WEIGHT: f32 = 8.0;
/// Memory for depth maps, bytes; beyond it only every n-th row and column is kept.
const MOST_MAP_BYTES: usize = 512 << 20;

/// A project with finished depth maps.
pub struct TrainingProject<'a> {
    pub name: String,
    pub model: Model<'a>,
    pub candidates: &'a Candidates,
    /// Clusters with the partners that were used.
    pub clusters: Vec<ViewCluster>,
    pub maps: Vec<DepthMapFile>,
    pub images: Option<ImageFolder>,
}

/// Options of a training.
pub struct TrainingOptions {
    pub backend: String,
    /// Minimum number of matches (method 3.4).
    pub min_matches: u32,
    pub seed: u64,
}

/// Features of the cells of judged pixels, with the outcome.
struct Pixels {
    part: usize,
    features: Vec<f32>,
    success: Vec<bool>,
}

/// Labels of one view.
struct JudgedView {
    view: ViewIndex,
    part: usize,
    /// Position in the image and success of the sampled pixels.
    drawn: Vec<(f32, f32, bool)>,
    /// Row of the visibility table, number of judged pixels, number of successes.
    triangles: Vec<(usize, u32, u32)>,
}

/// Trains on the projects; the same result for any number of threads.
pub fn train(
    lessons: &[TrainingProject],
    course: &TrainingOptions,
    watcher: &dyn Watcher,
) -> Result<TrainedModel, TrainError> {
    let parts = Parts::new(&lessons.iter().map(TrainingProject::views).collect::<Vec<_>>());
    let judged = judge(lessons, &parts, course.seed, watcher)?;
    if judged.iter().flatten().all(|view| view.drawn.is_empty()) {
        return Err(TrainError::NothingJudged);
    }
    watcher.progress(Stage::Train, 0, 4);
    let pixels = pixels(lessons, &judged, watcher)?;
    let pictures = PictureModels::train(&pixels, parts.count, course.seed);
    watcher.progress(Stage::Train, 1, 4);
    let (promised, reach) = promises(lessons, &parts, pictures.as_ref(), watcher)?;
    watcher.progress(Stage::Train, 2, 4);
    let rows: Vec<(usize, TrainingRow)> = rows(lessons, &parts, &judged, &promised, course.seed, watcher)?;
    let without = |part: usize| {
        let others: Vec<TrainingRow> = rows.iter().filter(|(p, _)| *p != part).map(|(_, row)| row.clone()).collect();
        FittedCurves::fit(&others, course.min_matches)
    };
    let without: Vec<FittedCurves> = (0..parts.count).map(without).collect();
    watcher.progress(Stage::Train, 3, 4);
    let left_out = rows.iter().map(|(part, row)| (without[*part].chance(row), row.success, row.weight));
    let scores = Scores::new(left_out.collect());
    let all: Vec<TrainingRow> = rows.into_iter().map(|(_, row)| row).collect();
    let curves = FittedCurves::fit(&all, course.min_matches);
    watcher.progress(Stage::Train, 4, 4);
    let (format, tool, licence) = TrainedModel::head();
    let pixel_scores = pictures.as_ref().map(|p| p.scores.clone()).unwrap_or_default();
    Ok(TrainedModel {
        format,
        version: VERSION,
        tool,
        licence,
        backend: course.backend.clone(),
        trained_on: lessons.iter().map(TrainingProject::summary).collect(),
        seed: course.seed,
        measured: ValidationScores {
            triangles: scores.count,
            auc: scores.auc,
            brier: scores.brier,
            calibration_error: scores.calibration_error,
            pixels: pixel_scores.count,
            pixel_auc: pixel_scores.auc,
            pixel_brier: pixel_scores.brier,
        },
        pair: curves.pair,
        place: curves.place,
        picture: pictures.map(|pictures| PictureModel { reach, ..pictures.all }),
    })
}

/// Labels all finished maps, by project.
fn judge(
    lessons: &[TrainingProject],
    parts: &Parts,
    seed: u64,
    watcher: &dyn Watcher,
) -> Result<Vec<Vec<JudgedView>>, TrainError> {
    let total: usize = lessons.iter().map(|l| l.maps.len()).sum();
    let done = AtomicU64::new(0);
    watcher.progress(Stage::Labels, 0, total as u64);
    let tick = || watcher.progress(Stage::Labels, 1 + done.fetch_add(1, Ordering::Relaxed), total as u64);
    let of_lesson = |(number, lesson): (usize, &TrainingProject)| {
        let part = |view: ViewIndex| parts.part_of(number, lesson.model.scene, view);
        let maps = lessons.iter().enumerate().filter(|(other, _)| parts.scene(*other) == parts.scene(number));
        let maps: usize = maps.map(|(_, l)| l.maps.len()).sum();
        lesson.judge(&part, MOST_PIXELS / parts.scenes / maps.max(1), seed, &tick, watcher)
    };
    lessons.iter().enumerate().map(of_lesson).collect()
}

impl TrainingProject<'_> {
    fn summary(&self) -> TrainedOn {
        TrainedOn { name: self.name.clone(), views: self.model.scene.views.len(), depth_maps: self.maps.len() }
    }

    fn views(&self) -> Views<'_> {
        let finished = self.maps.iter().map(|map| map.view).collect();
        Views { scene: self.model.scene, images: self.images.as_deref(), finished }
    }

    fn judge(
        &self,
        part: &(dyn Fn(ViewIndex) -> usize + Sync),
        draws: usize,
        seed: u64,
        tick: &(dyn Fn() + Sync),
        watcher: &dyn Watcher,
    ) -> Result<Vec<JudgedView>, TrainError> {
        let judge = |map: &DepthMapFile, labels: Vec<Label>| {
            let mut triangles: Vec<(usize, u32, u32)> = Vec::new();
            let mut by_row: Vec<(usize, bool)> = labels.iter().map(|l| (l.row, l.success)).collect();
            by_row.sort_unstable();
            for (row, success) in by_row {
                match triangles.last_mut().filter(|t| t.0 == row) {
                    Some(t) => (t.1, t.2) = (t.1 + 1, t.2 + u32::from(success)),
                    None => triangles.push((row, 1, u32::from(success))),
                }
            }
            let mut random = Pcg64Mcg::seed_from_u64(seed ^ u64::from(map.view.0).wrapping_mul(0x9e37_79b9_7f4a_7c15));
            let draws = draws.clamp(1, MOST_PER_IMAGE).min(labels.len());
            let draw = |_| {
                let label = labels[((u64::from(random.next_u32()) * labels.len() as u64) >> 32) as usize];
                (label.x, label.y, label.success)
            };
            tick();
            JudgedView { view: map.view, part: part(map.view), drawn: (0..draws).map(draw).collect(), triangles }
        };
        self.for_each_map(judge, watcher)
    }

    /// Maps each finished depth map and its labels through `look`.
    pub fn for_each_map<T: Send>(
        &self,
        look: impl Fn(&DepthMapFile, Vec<Label>) -> T + Sync,
        watcher: &dyn Watcher,
    ) -> Result<Vec<T>, TrainError> {
        let finished = self.finished(watcher)?;
        let others = |view: ViewIndex| self.candidates.candidates_of(view).to_vec();
        let labelling = Labelling { model: self.model, finished: &finished, others: &others };
        let of_map = |map: &DepthMapFile| {
            watcher.check()?;
            Ok(look(map, labelling.labels(map.view)))
        };
        self.maps.par_iter().map(of_map).collect()
    }

    /// Reads the depth maps by view, subsampled if they exceed the memory limit.
    fn finished(&self, watcher: &dyn Watcher) -> Result<Vec<Option<LabelledMap>>, TrainError> {
        let mut finished: Vec<Option<LabelledMap>> = self.model.scene.views.iter().map(|_| None).collect();
        let read = |file: &DepthMapFile| {
            watcher.check()?;
            let map = depthmaps::read_of_view(file, self.model.scene)?;
            Ok::<_, TrainError>(map.subsampled(MOST_MAP_BYTES / self.maps.len().max(1)))
        };
        let maps: Vec<_> = self.maps.par_iter().map(read).collect::<Result<_, _>>()?;
        for (file, map) in self.maps.iter().zip(maps) {
            let cluster = self.clusters.iter().find(|c| c.key == file.view);
            let cluster = cluster.ok_or_else(|| TrainError::NoCluster(self.model.scene.name(file.view).into()))?;
            finished[file.view.index()] = Some(LabelledMap { cluster: cluster.clone(), map });
        }
        Ok(finished)
    }

    fn image(&self, view: ViewIndex) -> Option<Features> {
        let folder = self.images.as_ref()?;
        Image::read(&folder.file(self.model.scene.name(view)), size_for_confidence)
            .ok()
            .map(|image| Features::new(&image))
    }
}

/// Computes features of the sampled pixels of all views with an image.
fn pixels(
    lessons: &[TrainingProject],
    judged: &[Vec<JudgedView>],
    watcher: &dyn Watcher,
) -> Result<Vec<Pixels>, Cancelled> {
    let views: Vec<(&TrainingProject, &JudgedView)> =
        lessons.iter().zip(judged).flat_map(|(l, j)| j.iter().map(move |v| (l, v))).collect();
    let of_view = |&(lesson, view): &(&TrainingProject, &JudgedView)| {
        watcher.check()?;
        let mut pixels = Pixels { part: view.part, features: Vec::new(), success: Vec::new() };
        if let Some(features) = lesson.image(view.view) {
            for &(x, y, success) in &view.drawn {
                let at = |share: f32, cells: u32| ((share * cells as f32) as u32).min(cells - 1) as usize;
                let cell = at(y, features.rows) * features.columns as usize + at(x, features.columns);
                pixels.features.extend(features.cell(cell));
                pixels.success.push(success);
            }
        }
        Ok(pixels)
    };
    views.par_iter().map(of_view).collect()
}

/// Picture classifiers: for each part the one trained on the others, and the one trained on all.
struct PictureModels {
    without: Vec<PictureModel>,
    all: PictureModel,
    scores: Scores,
}

impl PictureModels {
    /// Returns `None` without pictures.
    fn train(pixels: &[Pixels], parts: usize, seed: u64) -> Option<Self> {
        let classify = |wanted: &dyn Fn(usize) -> bool| {
            let chosen: Vec<&Pixels> = pixels.iter().filter(|p| wanted(p.part)).collect();
            let features: Vec<f32> = chosen.iter().flat_map(|p| p.features.iter().copied()).collect();
            let success: Vec<bool> = chosen.iter().flat_map(|p| p.success.iter().copied()).collect();
            if success.is_empty() {
                return None;
            }
            let table = Table::new(features::COUNT, success.len(), |row, f| features[row * features::COUNT + f]);
            let how = Boosting { trees: 60, max_depth: 5, learning_rate: 0.12, row_share: 0.5, min_leaf: 30.0 };
            let classifier = how.train(&table, &success, &vec![1.0; success.len()], seed);
            let cumulative = (0..features::COUNT).map(|f| cumulative(table.column(f))).collect();
            Some(PictureModel { classifier, calibration: [1.0, 0.0], cumulative, reach: 1.0 })
        };
        let mut all = classify(&|_| true)?;
        // Possibly none of the other parts has a picture.
        let mut without: Vec<PictureModel> =
            (0..parts).map(|part| classify(&|p| p != part).unwrap_or_else(|| all.clone())).collect();
        let trees = best_length(&without, pixels);
        without.iter_mut().chain([&mut all]).for_each(|picture| picture.classifier.trees.truncate(trees));
        let left_out = pixels.iter().flat_map(|p| {
            let of =
                |(features, &success): (&[f32], &bool)| (without[p.part].classifier.probability(features), success);
            p.features.chunks_exact(features::COUNT).zip(&p.success).map(of).collect::<Vec<_>>()
        });
        let left_out: Vec<(f32, bool)> = left_out.collect();
        all.calibration = calibrate(&left_out);
        without.iter_mut().for_each(|picture| picture.calibration = all.calibration);
        let score = |&(chance, success): &(f32, bool)| (all.calibrated(chance), f32::from(u8::from(success)), 1.0);
        let scores = Scores::new(left_out.iter().map(score).collect());
        Some(Self { without, all, scores })
    }
}

/// Returns the number of trees with the largest out-of-sample likelihood; further trees overfit to their scenes.
fn best_length(without: &[PictureModel], pixels: &[Pixels]) -> usize {
    let mut losses = vec![0.0; without.iter().map(|p| p.classifier.trees.len()).max().unwrap_or(0)];
    for p in pixels {
        for (features, &success) in p.features.chunks_exact(features::COUNT).zip(&p.success) {
            let odds = without[p.part].classifier.odds_by_tree(features);
            let wrong = |odds: f32| f64::from(if success { -odds } else { odds });
            losses.iter_mut().zip(odds).for_each(|(loss, odds)| *loss += wrong(odds).exp().ln_1p());
        }
    }
    let best = losses.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1));
    best.map_or(0, |(tree, _)| tree + 1)
}

/// Returns the share of the values up to each bin.
fn cumulative(column: &[u8]) -> Vec<f32> {
    let mut counts = [0u32; BINS];
    column.iter().for_each(|&bin| counts[usize::from(bin)] += 1);
    let mut sum = 0;
    let share = |count: &u32| {
        sum += count;
        sum as f32 / column.len() as f32
    };
    counts.iter().map(share).collect()
}

/// Fits factor and shift of log odds to the outcomes (Platt 1999), by Newton's method.
fn calibrate(outcomes: &[(f32, bool)]) -> [f32; 2] {
    let (mut a, mut b) = (1.0f64, 0.0f64);
    for _ in 0..20 {
        // A weak pull towards the classifier's own output keeps the equations regular.
        let (mut ga, mut gb, mut aa, mut ab, mut bb) = (a - 1.0, b, 1.0, 0.0, 1.0);
        for &(chance, success) in outcomes {
            let x = f64::from(place::odds_of(chance));
            let p = 1.0 / (1.0 + (-(a * x + b)).exp());
            let (error, slope) = (p - f64::from(u8::from(success)), p * (1.0 - p));
            (ga, gb) = (ga + error * x, gb + error);
            (aa, ab, bb) = (aa + slope * x * x, ab + slope * x, bb + slope);
        }
        let determinant = aa * bb - ab * ab;
        (a, b) = (a - (bb * ga - ab * gb) / determinant, b - (aa * gb - ab * ga) / determinant);
    }
    [a as f32, b as f32]
}

/// Predicts each row of each project's visibility table by the classifier that was not trained on the view (NaN: no picture). Also returns the
/// 95th percentile of the distances between an image and all others.
fn promises(
    lessons: &[TrainingProject],
    parts: &Parts,
    pictures: Option<&PictureModels>,
    watcher: &dyn Watcher,
) -> Result<(Vec<Vec<f32>>, f32), TrainError> {
    let mut promised = Vec::new();
    let mut distances = Vec::new();
    for (number, lesson) in lessons.iter().enumerate() {
        let scene = lesson.model.scene;
        let views: Vec<ViewIndex> = scene.view_indices().collect();
        let look = |&view: &ViewIndex| {
            watcher.check()?;
            let looked = pictures.zip(lesson.image(view)).map(|(pictures, features)| {
                let chances = pictures.without[parts.part_of(number, scene, view)].of_cells(&features).0;
                let map = ConfidenceMap::new([features.columns, features.rows], chances.into_iter());
                (map, pictures.all.of_cells(&features).1)
            });
            Ok(looked)
        };
        let looked: Vec<Option<(ConfidenceMap, f32)>> = views.par_iter().map(look).collect::<Result<_, Cancelled>>()?;
        distances.extend(looked.iter().flatten().map(|l| l.1));
        let maps: Vec<Option<ConfidenceMap>> = looked.into_iter().map(|l| l.map(|l| l.0)).collect();
        let unary = Unary::new(scene, lesson.model.surface, lesson.model.visibility, &maps, watcher)?;
        let of_view = |&view: &ViewIndex| {
            let known = maps[view.index()].is_some();
            lesson
                .model
                .visibility
                .rows(view)
                .map(|row| if known { unary.confidence(row) } else { f32::NAN })
                .collect::<Vec<_>>()
        };
        promised.push(views.iter().flat_map(of_view).collect());
    }
    distances.sort_unstable_by(f32::total_cmp);
    let reach = distances.get(distances.len() * 19 / 20).copied().unwrap_or(1.0).max(1e-3);
    Ok((promised, reach))
}

/// Collects the rows for the curves, each with its part; the same limit for each scene.
fn rows(
    lessons: &[TrainingProject],
    parts: &Parts,
    judged: &[Vec<JudgedView>],
    promised: &[Vec<f32>],
    seed: u64,
    watcher: &dyn Watcher,
) -> Result<Vec<(usize, TrainingRow)>, TrainError> {
    let mut counts = vec![0usize; parts.scenes];
    for (lesson, judged) in judged.iter().enumerate() {
        counts[parts.scene(lesson)] += judged.iter().map(|view| view.triangles.len()).sum::<usize>();
    }
    let most = MOST_TRIANGLES as f64 / parts.scenes as f64;
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let mut rows = Vec::new();
    for (number, ((lesson, judged), promised)) in lessons.iter().zip(judged).zip(promised).enumerate() {
        let kept_below = (most / counts[parts.scene(number)].max(1) as f64 * f64::from(u32::MAX)) as u32;
        let model = &lesson.model;
        let places = PlaceFeatures::new(model.geometry(), &model.scene.view_points(), watcher)?;
        let of_place = |view: ViewIndex, row: usize| places.numbers(view, row, promised[row]);
        for view in judged {
            let Some(cluster) = lesson.clusters.iter().find(|c| c.key == view.view) else { continue };
            for &(row, pixels, right) in &view.triangles {
                if random.next_u32() > kept_below {
                    continue;
                }
                let triangle = model.visibility.triangles[row];
                let pair = |&partner: &ViewIndex| {
                    let place = of_place(partner, model.visibility.row(partner, triangle)?);
                    let constellation = Constellation::new(&model.geometry(), view.view, partner, triangle);
                    Some(PairRow { numbers: constellation.numbers(), place })
                };
                let row = TrainingRow {
                    place: of_place(view.view, row),
                    pairs: cluster.partners.iter().filter_map(pair).collect(),
                    success: right as f32 / pixels as f32,
                    weight: (pixels as f32 / FULL_WEIGHT).min(1.0),
                };
                rows.push((view.part, row));
            }
        }
    }
    Ok(rows)
}

/// An error of training.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    #[error(transparent)]
    DepthMap(#[from] DepthMapError),
    #[error("it is not known which partners view {0} was matched with")]
    NoCluster(String),
    #[error(
        "no two depth maps see the same place from viewpoints 5 degrees apart, so that none can be judged by others"
    )]
    NothingJudged,
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    #[error(transparent)]
    Table(#[from] TableError),
}

impl Hint for TrainError {
    fn hint(&self) -> Option<String> {
        Some(match self {
            Self::DepthMap(error) => return error.hint(),
            Self::NoCluster(_) => "keep the matcher's report beside its maps, or plan the project first".into(),
            Self::NothingJudged => "train on depth maps of more views, at best of a whole plan".into(),
            Self::Cancelled(_) => return None,
            Self::Table(error) => return error.hint(),
        })
    }
}
