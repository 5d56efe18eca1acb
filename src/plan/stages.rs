//! Runs the stages of the method before the ranking, and keeps the result of each.

use std::{cell::LazyCell, sync::Arc};

use super::{
    GroundSummary, Matcher, Memory, PlanError, Timings, UncutRanking, WorkPerMap,
    cached::{self, Cached},
    inputs::Inputs,
    pilot_maps::PilotMaps,
    step::Run,
    steps::{self, ClustersStep, PilotStep, ShownStep, TwinsStep, UnaryStep},
};
use crate::{
    base::{large_pages, progress::Watcher},
    config::Settings,
    decision::{CountedPlaces, PlacesRule, Tables},
    io::project::{ImageFaults, Project},
    method::{
        confidence::{Confidence, Sharpness},
        fulfilment::Model,
        geometry::Geometry,
        pilot::Thumbnails,
        ranking::Objective,
        region::{Ground, Region},
        surface::{Surface, SurfaceStats},
        target::Target,
        visibility::Shown,
    },
    model::{
        cluster::{MapScale, ViewCluster},
        georeference::Georeference,
        scene::Scene,
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
    /// False if the backend uses the images themselves and makes no depth maps.
    pub makes_maps: bool,
    /// True if maps of half the size were requested, but the backend supports only one size.
    pub refused_half: bool,
    /// Name of the backend that the plan is made for.
    pub backend: &'static str,
    /// Median ground sampling distance of the model's images, scene units per pixel; `None` without
    /// points.
    pub image_gsd: Option<f64>,
    /// Place of the model on earth.
    pub place: Georeference,
    /// Metres in a scene unit; `None` if unknown.
    pub metres: Option<f64>,
    /// The area of the region on the map; `None` without a region, and of one that is a part of
    /// the surface.
    pub ground: Option<Ground>,
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
    pub cached: Cached,
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
        let own_size = settings.image_scale.is_none();
        let refused_half = settings.ranking.has_half() && !matcher.mixes_sizes;
        let mut run = Run { timings, watcher };
        let mut inputs = Inputs::new(project, scene, settings, matcher, run.timings)?;
        let pixels = inputs.most_pixels;
        let mut memory =
            Memory::before_surface(&inputs.scene, &mut inputs.settings, pixels, watcher)?;

        let (twins_file, twins) = run.step(TwinsStep { inputs: &inputs })?;
        let ((surface_file, seen), (candidates_file, candidates)) =
            steps::surface_and_candidates(&inputs, &twins, &mut memory, &mut run)?;
        memory.before_partners(&inputs.scene, &seen.surface, &seen.visibility)?;

        let (shown_file, shown) = run.step(ShownStep {
            inputs: &inputs,
            surface_file: &surface_file,
            seen: &seen,
        })?;
        let (region, ground) = steps::region(&mut inputs, &twins, &seen, &shown, &mut run)?.unzip();
        let inputs = inputs;
        let settings = &inputs.settings;
        let target = Target::new(&shown, &settings.target, seen.gsd, settings.image_scale());
        let target = match &region {
            Some(region) => target.with_wishes(region),
            None => target,
        };
        let objective = objective(&inputs, &seen.surface, &shown, region.as_ref());
        let geometry = Geometry {
            scene: &inputs.scene,
            surface: &seen.surface,
            visibility: &seen.visibility,
            target: &target,
            image_scale: settings.image_scale(),
        };
        seen.visibility.triangles.release();
        large_pages::return_freed_memory();

        // Read from their headers, where masks or pictures have to be read.
        let mask_bytes = LazyCell::new(|| inputs.pictures.most_mask_bytes(&inputs.scene));
        let (unary_file, (unary, mut picture_warnings)) = run.step(UnaryStep {
            inputs: &inputs,
            surface_file: &surface_file,
            geometry,
            memory: &mut memory,
            mask_bytes: &|| *mask_bytes,
        })?;
        let room = || memory.before_pictures(&geometry, *mask_bytes);
        let thumbnails = Thumbnails::new(inputs.scene.views.len());
        let compared =
            steps::agreement(&inputs, &geometry, &candidates, room, &thumbnails, &mut run)?;
        let (agreement_file, agreement) = compared.unzip();
        let agreement = agreement.unwrap_or_default();
        picture_warnings.extend(agreement.warnings.iter().cloned());

        let model = Model::new(geometry, &unary, &agreement, inputs.rule());
        let rule = model.rule;
        let (clusters_file, (clusters, fulfilment, half)) = run.step(ClustersStep {
            inputs: &inputs,
            from: [&surface_file, &candidates_file, &unary_file],
            agreement_file: agreement_file.as_ref(),
            model,
            candidates: &candidates,
        })?;
        large_pages::return_freed_memory();

        // Where fusion keeps what a single map shows, how well it shows it is all that counts.
        let is_agreement_wanted = objective.support > 1;
        let has_pictures = matches!(inputs.confidence, Confidence::Photometric { .. })
            && inputs.pictures.have_images();
        let made = settings.pilot.maps.as_deref();
        let made = made.map(|folder| PilotMaps::find(folder, &inputs.scene));
        let made = made.transpose()?;
        let seen_in_thumbnails = match (has_pictures || made.is_some()) && is_agreement_wanted {
            true => Some(run.step(PilotStep {
                inputs: &inputs,
                clusters_file: &clusters_file,
                clusters: &clusters,
                made: made.as_ref(),
                thumbnails,
                memory: &mut memory,
            })?),
            false => None,
        };
        let (pilot_file, places) = seen_in_thumbnails.unzip();
        let rule_of_places = PlacesRule {
            surface: &seen.surface,
            region: region.as_ref(),
            objective: &objective,
            weight: settings.ranking.weight,
            half_worth: settings.ranking.half_worth,
            sharpness: Sharpness::new(&inputs.scene, &agreement.detail),
        };
        let pilot = places.and_then(|places| {
            let predicted = (&fulfilment, half.as_ref());
            CountedPlaces::new(Arc::new(places), &clusters, predicted, &rule_of_places)
        });
        let per_map = matcher.numbers.work;
        let work: Vec<_> = clusters
            .iter()
            .map(|cluster| work(&inputs.scene, settings.image_scale(), per_map, cluster))
            .collect();

        let factors = region.as_ref().map(|region| &region.factors[..]);
        let from = pilot_file.as_ref().unwrap_or(&clusters_file);
        let file = inputs
            .fingerprints
            .ranking(settings, &from.file, &objective, factors, &work);
        let triangles = seen.surface.triangles.len();
        let (ranking_file, known_ranking) = cached::read(file, |(), bytes| {
            cached::ranking::unpack(bytes, clusters.len(), triangles)
        });
        watcher.check()?;

        let mut without_image = inputs.without_image;
        without_image.extend(&agreement.rejected);
        without_image.sort_unstable();
        Ok(Self {
            own_size,
            mixes_sizes: matcher.mixes_sizes,
            makes_maps: matcher.makes_maps,
            refused_half,
            backend: matcher.name,
            image_gsd: inputs.image_gsd,
            place: inputs.place,
            metres: inputs.metres,
            ground: ground.flatten(),
            image_faults: inputs.image_faults,
            settings: inputs.settings,
            surface_stats: seen.stats,
            picture_warnings,
            tables: Tables {
                scene: inputs.scene,
                surface: seen.surface,
                visibility: seen.visibility,
                shown,
                region,
                target,
                without_image,
                twins,
                candidates,
                unary,
                agreement,
                rule,
                objective,
                clusters,
                fulfilment,
                half,
                pilot,
                work,
            },
            per_map,
            known_ranking,
            cached: Cached {
                twins: twins_file,
                surface: surface_file,
                shown: shown_file,
                candidates: candidates_file,
                unary: unary_file,
                agreement: agreement_file,
                clusters: clusters_file,
                pilot: pilot_file,
                ranking: ranking_file,
                made: None,
            },
            memory,
        })
    }

    /// The area of the region in numbers.
    pub fn ground_summary(&self) -> Option<GroundSummary> {
        let ground = self.ground.as_ref()?;
        Some(GroundSummary::new(ground, true))
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

/// Returns the work of a cluster's map at full and at half size.
fn work(scene: &Scene, image_scale: f64, work: WorkPerMap, cluster: &ViewCluster) -> [f64; 2] {
    let camera = scene.camera_of(cluster.key);
    let megapixels = f64::from(camera.width) * f64::from(camera.height) * image_scale.powi(2) / 1e6;
    [MapScale::Full, MapScale::Half]
        .map(|scale| work.map_work(megapixels * scale.factor().powi(2), cluster.partners.len()))
}

/// Returns the objective of the settings (method 5.1).
fn objective(
    inputs: &Inputs,
    surface: &Surface,
    shown: &Shown,
    region: Option<&Region>,
) -> Objective {
    let settings = &inputs.settings.ranking;
    let support = settings.support.unwrap_or(inputs.matcher.numbers.support);
    Objective::new(surface, shown, settings.weight, region, support)
}
