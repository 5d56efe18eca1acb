//! Runs the stages of the method before the ranking, and keeps the result of each.

use std::cell::LazyCell;

use super::{
    Matcher, Memory, PlanError, PlanningNumbers, Timings, UncutRanking, WorkPerMap, georeference,
    kept::{self, Inputs, Kept, Slot, Slotted, clusters::KeptClusters},
    region,
    visible_surface::VisibleSurface,
};
use crate::{
    base::{
        large_pages,
        progress::{Cancelled, Stage, Watcher},
    },
    config::{ConfidenceSource, Settings, Share},
    decision::{DEFAULT_TARGET, Tables},
    io::{
        cache::CacheFile,
        pictures::Pictures,
        project::{ImageFaults, Project},
    },
    method::{
        confidence::{
            self, Agreement, Confidence, ProgramReach, ReachOfPartner, SampleRoom, Unary,
        },
        fulfilment::{self, FulfilmentRule, Model},
        geometry::Geometry,
        partners::{self, CandidateSearch, Candidates, Limits, PairGeometry, Refuses},
        ranking::Objective,
        region::RegionShape,
        surface::SurfaceStats,
        target::{GSD_MARGIN, Target},
        visibility::Shown,
    },
    model::{
        cluster::{MapScale, Reach, ViewCluster},
        georeference::MapFrame,
        scene::{Scene, Units, ViewIndex, ViewPoints},
    },
};

/// Results of the stages of the method, up to the view clusters and their fulfilment.
#[derive(Clone, Debug)]
pub struct Stages {
    /// All settings in force, with those chosen from the data or by the backend filled in.
    pub settings: Settings,
    /// True if `settings.image_scale` is the backend's default.
    pub own_size: bool,
    /// True if the backend can match key views at different sizes.
    pub mixes_sizes: bool,
    /// True if maps of half the size were requested, but the backend supports only one size.
    pub refused_half: bool,
    /// Name of the backend that the plan is made for.
    pub backend: &'static str,
    /// Median ground sampling distance of the model's images, scene units per pixel; `None` without
    /// points.
    pub image_gsd: Option<f64>,
    pub surface_stats: SurfaceStats,
    /// A sentence for each picture or mask that cannot be used.
    pub picture_warnings: Vec<String>,
    pub image_faults: ImageFaults,
    pub tables: Tables,
    /// Numbers of the backend that `work` is made from.
    pub per_map: WorkPerMap,
    /// The ranking that an earlier plan has found, with what follows from it; `None`: to be made.
    pub known_ranking: Option<UncutRanking>,
    /// Where the results are kept for the next plan.
    pub kept: Kept,
    /// Memory forecast before each stage.
    pub memory: Memory,
}

impl Stages {
    /// Runs the stages on the project's scene, for the MVS program that will match the clusters;
    /// records their seconds in `timings`.
    pub fn run(
        project: &Project,
        scene: Scene,
        settings: &Settings,
        matcher: &Matcher,
        timings: &mut Timings,
        watcher: &dyn Watcher,
    ) -> Result<Self, PlanError> {
        let source = settings
            .confidence
            .source
            .in_force(project.images.is_some());
        let own_size = settings.image_scale.is_none();
        let refused_half = settings.ranking.has_half() && !matcher.mixes_sizes;
        let (points, inputs, image_gsd, mut settings, shape) = timings.time(Stage::Read, || {
            let (points, inputs) =
                rayon::join(|| scene.view_points(), || Inputs::new(project, &scene));
            let image_gsd = scene.median_gsd_of(&points);
            let settings = in_force(project, settings, (&scene, image_gsd), matcher, source)?;
            let shape = shape(project, &scene, &settings)?;
            Ok::<_, PlanError>((points, inputs, image_gsd, settings, shape))
        })?;
        refuse_other_images(project, &scene, &settings)?;
        let numbers = &matcher.numbers;
        let image_faults = project.image_faults(&scene);
        let pixels = if project.images.is_some() {
            image_faults.most_pixels(&scene)
        } else {
            0
        };
        let mut memory = Memory::before_surface(&scene, &mut settings, pixels, watcher)?;
        let mut without_image = image_faults.without_image(scene.views.len());
        let matching = (matcher, &without_image[..]);
        let ((surface_slot, seen), (candidates_slot, candidates)) =
            timings.time_rest(Stage::Partners, |timings| {
                surface_and_candidates(
                    (&scene, &points),
                    &settings,
                    matching,
                    &inputs,
                    watcher,
                    timings,
                    &mut memory,
                )
            })?;
        memory.before_partners(&scene, &seen.surface, &seen.visibility)?;
        let (shown_slot, shown) = timings.time(Stage::Visibility, || {
            shown(inputs.shown(&surface_slot.file), &scene, &seen)
        })?;
        let region = timings.time(Stage::Visibility, || {
            shape
                .map(|shape| shape.lay_over(&seen.surface, &shown.pixels, watcher))
                .transpose()
        })?;
        let target = Target::new(&shown, &settings.target, seen.gsd, settings.image_scale());
        let target = match &region {
            Some(region) => target.with_wishes(region),
            None => target,
        };
        seen.visibility.triangles.release();
        large_pages::return_freed_memory();
        let confidence = Confidence::new(
            source,
            &settings.confidence,
            &numbers.confidence,
            &numbers.photometric,
        );
        confidence.fill_in(&mut settings.confidence);
        let geometry = Geometry {
            scene: &scene,
            surface: &seen.surface,
            visibility: &seen.visibility,
            target: &target,
            image_scale: settings.image_scale(),
        };
        let support = settings.ranking.support.unwrap_or(matcher.numbers.support);
        let objective = Objective::new(
            &seen.surface,
            &shown,
            settings.ranking.weight,
            region.as_ref(),
            support,
        );
        let pictures = Pictures::new(project).without(&without_image);
        let unary_file = inputs.unary(&scene, &surface_slot.file, confidence, &pictures);
        // Read from their headers, where masks or pictures have to be read.
        let of_mask = LazyCell::new(|| pictures.most_mask_bytes(&scene));
        let (unary_slot, (unary, mut picture_warnings)) =
            timings.time(Stage::Confidence, || {
                let batch = || memory.before_masks(&geometry, *of_mask);
                unary(
                    unary_file, &geometry, &points, confidence, &pictures, batch, watcher,
                )
            })?;
        let compared = timings.time(Stage::Confidence, || match confidence {
            Confidence::Photometric { .. } => {
                let room = || memory.before_pictures(&geometry, *of_mask);
                let compared = agreement(
                    &pictures,
                    &geometry,
                    &points,
                    &candidates,
                    matcher,
                    room,
                    watcher,
                );
                compared.map(Some)
            }
            _ => Ok(None),
        })?;
        let (agreement_slot, agreement) = compared.unzip();
        let agreement = agreement.unwrap_or_default();
        picture_warnings.extend(agreement.warnings.iter().cloned());
        without_image.extend(&agreement.rejected);
        without_image.sort_unstable();
        let model = Model::new(geometry, &unary, &agreement, rule(&settings, confidence));
        let from = [&surface_slot.file, &candidates_slot.file, &unary_slot.file];
        let compared = match agreement.is_empty() {
            true => Some(""),
            false => agreement_slot
                .as_ref()
                .and_then(|slot: &Slot| slot.file.inputs()),
        };
        let clusters_file = inputs.clusters(&settings, from, compared, &target, &model.rule);
        let (clusters_slot, (clusters, fulfilment, half)) = timings
            .time(Stage::Partners, || {
                clusters(clusters_file, &model, &candidates, &settings, watcher)
            })?;
        large_pages::return_freed_memory();
        let per_map = numbers.work;
        let work: Vec<_> = clusters
            .iter()
            .map(|cluster| work(&scene, settings.image_scale(), per_map, cluster))
            .collect();
        let factors = region.as_ref().map(|region| &region.factors[..]);
        let ranking_file =
            inputs.ranking(&settings, &clusters_slot.file, &objective, factors, &work);
        let triangles = seen.surface.triangles.len();
        let (ranking, known_ranking) = kept::read(ranking_file, |(), bytes| {
            kept::ranking::unpack(bytes, clusters.len(), triangles)
        });
        watcher.check()?;
        let kept = Kept {
            surface: surface_slot,
            shown: shown_slot,
            candidates: candidates_slot,
            unary: unary_slot,
            agreement: agreement_slot,
            clusters: clusters_slot,
            ranking,
            made: None,
        };
        let rule = model.rule;
        Ok(Self {
            settings,
            own_size,
            mixes_sizes: matcher.mixes_sizes,
            refused_half,
            backend: matcher.name,
            image_gsd,
            surface_stats: seen.stats,
            picture_warnings,
            image_faults,
            tables: Tables {
                scene,
                surface: seen.surface,
                visibility: seen.visibility,
                shown,
                region,
                target,
                without_image,
                candidates,
                unary,
                agreement,
                rule,
                objective,
                clusters,
                fulfilment,
                half,
                work,
            },
            per_map,
            known_ranking,
            kept,
            memory,
        })
    }

    /// Returns the work of each cluster's map at full and at half size.
    pub fn work_of(&self, clusters: &[ViewCluster]) -> Vec<[f64; 2]> {
        let scale = self.settings.image_scale();
        clusters
            .iter()
            .map(|cluster| work(&self.scene, scale, self.per_map, cluster))
            .collect()
    }
}

impl std::ops::Deref for Stages {
    type Target = Tables;

    fn deref(&self) -> &Tables {
        &self.tables
    }
}

/// Returns an error if the image folder that the user has set holds no image of the scene.
fn refuse_other_images(
    project: &Project,
    scene: &Scene,
    settings: &Settings,
) -> Result<(), PlanError> {
    match (&project.images, scene.view_indices().next()) {
        (Some(folder), Some(first))
            if settings.images.is_some() && project.has_only_other_images(scene) =>
        {
            Err(PlanError::OtherImages {
                folder: folder.to_path_buf(),
                name: scene.name(first).into(),
            })
        }
        _ => Ok(()),
    }
}

/// Fills in the settings that depend on the data and the backend.
fn in_force(
    project: &Project,
    settings: &Settings,
    (scene, image_gsd): (&Scene, Option<f64>),
    matcher: &Matcher,
    source: ConfidenceSource,
) -> Result<Settings, PlanError> {
    if scene.views.is_empty() {
        return Err(PlanError::NoViews(project.model.path.clone()));
    }
    let mut all = settings.clone();
    all.units.get_or_insert(Units::Relative);
    all.image_scale
        .get_or_insert_with(|| matcher.image_scale(scene));
    let gsd = match all.target.gsd {
        Some(gsd) => gsd,
        None => GSD_MARGIN * image_gsd.ok_or(PlanError::NoScale)? / all.image_scale(),
    };
    all.target.accuracy.get_or_insert(gsd);
    all.target.mode = all
        .target
        .mode
        .in_force(settings.target.gsd.or(settings.target.accuracy).is_some());
    all.target.gsd = Some(gsd);
    all.partners.candidates = all.partners.candidates.max(all.partners.k);
    all.partners.gate = matcher.numbers.gate.with(&all.partners.gate).settings();
    all.ranking.support.get_or_insert(matcher.numbers.support);
    all.confidence.source = source;
    if all.partners.k == 1 {
        all.coverage.min_cameras = 2;
    }
    let cut = &mut all.cut;
    if cut.budget.is_none() && cut.time.is_none() && cut.points.is_none() {
        cut.target.get_or_insert(Share(DEFAULT_TARGET));
    }
    if !matcher.mixes_sizes {
        all.ranking.scales = vec![MapScale::Full];
    }
    Ok(all)
}

/// Returns the work of a cluster's map at full and at half size.
fn work(scene: &Scene, image_scale: f64, work: WorkPerMap, cluster: &ViewCluster) -> [f64; 2] {
    let camera = scene.camera_of(cluster.key);
    let megapixels = f64::from(camera.width) * f64::from(camera.height) * image_scale.powi(2) / 1e6;
    [MapScale::Full, MapScale::Half]
        .map(|scale| work.map_work(megapixels * scale.factor().powi(2), cluster.partners.len()))
}

/// Returns the unary confidence of each row of the visibility, and warnings of masks that cannot be
/// used. `batch`: number of views whose masks are read together.
fn unary(
    file: CacheFile,
    geometry: &Geometry,
    points: &ViewPoints,
    confidence: Confidence,
    pictures: &Pictures,
    batch: impl FnOnce() -> Result<usize, PlanError>,
    watcher: &dyn Watcher,
) -> Result<Slotted<(Unary, Vec<String>)>, PlanError> {
    let Geometry {
        scene,
        surface,
        visibility,
        ..
    } = *geometry;
    let unpack = |warnings, bytes: &[u8]| {
        Some((
            kept::unary::unpack(bytes, visibility.triangles.len())?,
            warnings,
        ))
    };
    kept::read_or(file, unpack, || {
        if let Confidence::None = confidence {
            return Ok((Unary::certain(), Vec::new()));
        }
        let unused = pictures.unused_masks(scene);
        let (masks, faults) = match pictures.have_masks() && unused.is_none() {
            true => Unary::of_masks(geometry, pictures, batch()?, watcher)?,
            false => Default::default(),
        };
        let nearby = confidence::nearby(scene, points, surface, visibility, watcher)?;
        let broken = match confidence {
            // A mask that cannot be used is named with its picture.
            Confidence::Photometric { .. } if pictures.have_images() => Vec::new(),
            _ => confidence::picture_warnings(scene, &faults, confidence::ALL_COUNTS),
        };
        let unused = unused.map(|[what, cure]| format!("{what}: {cure}"));
        Ok((
            nearby.within(masks),
            unused.into_iter().chain(broken).collect(),
        ))
    })
}

/// Chooses the clusters, and computes their fulfilment at full and, if there is a choice of sizes,
/// at half size.
fn clusters(
    file: CacheFile,
    model: &Model,
    candidates: &Candidates,
    settings: &Settings,
    watcher: &dyn Watcher,
) -> Result<Slotted<KeptClusters>, PlanError> {
    let has_half = settings.ranking.has_half();
    let unpack = |(), bytes: &[u8]| kept::clusters::unpack(bytes, model.visibility, has_half);
    kept::read_or(file, unpack, || {
        let (clusters, fulfilment) = partners::choose(
            model,
            candidates,
            &settings.partners,
            settings.seed,
            watcher,
        )?;
        let half = match has_half {
            true => Some(fulfilment::half_size(
                model,
                &clusters,
                &fulfilment,
                settings.ranking.half_worth,
                watcher,
            )?),
            false => None,
        };
        Ok((clusters, fulfilment, half))
    })
}

/// Compares the pictures of candidate pairs, within what the backend can match of each.
fn agreement(
    pictures: &Pictures,
    geometry: &Geometry,
    points: &ViewPoints,
    candidates: &Candidates,
    matcher: &Matcher,
    room: impl FnOnce() -> Result<SampleRoom, PlanError>,
    watcher: &dyn Watcher,
) -> Result<Slotted<Agreement>, PlanError> {
    let of_key_view = |key| -> ReachOfPartner {
        let Some(rule) = matcher.numbers.reach else {
            return Box::new(|_| Reach::Everything);
        };
        let pairs = rule(geometry.scene, points, key, geometry.image_scale);
        Box::new(move |partner| {
            let shared = points.shared(key, partner);
            pairs.reach(&PairGeometry::new(geometry.scene, key, partner, &shared))
        })
    };
    let reach = ProgramReach {
        program: matcher.numbers.reach.map(|_| matcher.name),
        of_key_view: &of_key_view,
    };
    let partners = |view| candidates.candidates_of(view);
    let file = kept::agreement::file(geometry, pictures, partners, reach.program);
    Ok(match kept::agreement::read(file, geometry, partners)? {
        (slot, Some(agreement)) => (slot, agreement),
        (slot, None) => {
            let agreement = Agreement::new(geometry, pictures, partners, &reach, room()?, watcher)?;
            (slot, agreement)
        }
    })
}

/// Returns the surface, and the candidate partners of each view within the gate, among pairs that
/// the backend can match and that have images; those of an earlier plan if nothing has changed.
fn surface_and_candidates(
    from @ (scene, points): (&Scene, &ViewPoints),
    settings: &Settings,
    (matcher, without_image): (&Matcher, &[ViewIndex]),
    inputs: &Inputs,
    watcher: &dyn Watcher,
    timings: &mut Timings,
    memory: &mut Memory,
) -> Result<(Slotted<VisibleSurface>, Slotted<Candidates>), PlanError> {
    let PlanningNumbers { reach, gate, .. } = matcher.numbers;
    let gate = gate.with(&settings.partners.gate);
    let file = inputs.candidates(settings, reach.map(|_| matcher.name), &gate, without_image);
    let (slot, known) = kept::read(file, |(), bytes| {
        kept::candidates::unpack(bytes, scene.views.len())
    });
    let lacks_image = |view: &ViewIndex| without_image.binary_search(view).is_ok();
    let refusals_of = |key| -> Refuses {
        let reach = reach.map(|rule| rule(scene, points, key, settings.image_scale()));
        Box::new(move |pair| {
            [pair.key, pair.partner].iter().any(lacks_image)
                || reach.as_ref().is_some_and(|reach| reach.refuses(pair))
        })
    };
    let limits = Limits {
        gate: &gate,
        refusals_of: &refusals_of,
    };
    let search = CandidateSearch::new(scene, points, &settings.partners, &limits, watcher);
    let mut surface = Err(Cancelled.into());
    // Parts of the surface are built by one thread, and the others find candidates meanwhile.
    // Called from outside the thread pool, these jobs wait in its queue, where threads look only
    // when nothing of the surface is left to share; on a thread of the pool, they merely run beside
    // it.
    rayon::in_place_scope_fifo(|jobs| {
        jobs.spawn_fifo(|_| {
            surface = VisibleSurface::kept_or_new(from, settings, inputs, watcher, timings, memory)
        });
        if known.is_none() {
            search.start(jobs);
        }
    });
    let surface = surface?;
    let candidates = match known {
        Some(candidates) => candidates,
        None => search.finish()?,
    };
    Ok((surface, (slot, candidates)))
}

/// Returns number of views, pixels and finest GSD of each triangle.
fn shown(
    file: CacheFile,
    scene: &Scene,
    seen: &VisibleSurface,
) -> Result<Slotted<Shown>, PlanError> {
    let unpack = |(), bytes: &[u8]| {
        kept::shown::unpack(bytes, scene.views.len(), seen.surface.triangles.len())
    };
    kept::read_or(file, unpack, || {
        Ok(Shown::new(scene, &seen.surface, &seen.visibility))
    })
}

/// Reads the region of the settings, before the surface is built.
fn shape(
    project: &Project,
    scene: &Scene,
    settings: &Settings,
) -> Result<Option<RegionShape>, PlanError> {
    let Some(choice) = &settings.region else {
        return Ok(None);
    };
    let place = georeference(project, scene, &settings.frame);
    Ok(Some(region::read(
        choice,
        &place,
        &MapFrame::new(scene, settings.surface.up),
    )?))
}

fn rule(settings: &Settings, confidence: Confidence) -> FulfilmentRule {
    FulfilmentRule {
        alpha: settings.fulfilment.alpha,
        sigma_px: settings.fulfilment.sigma_px,
        min_cameras: settings.coverage.min_cameras,
        image_scale: settings.image_scale(),
        confidence,
    }
}
