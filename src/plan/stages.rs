//! Runs the stages of the method before the ranking, and keeps the result of each.

use std::sync::Arc;

use super::{
    GroundSummary, Matcher, Memory, PlanError, Timings, UncutRanking, WorkPerMap,
    cached::{self, Cached, Filed, ResultFile, clusters::CachedClusters},
    inputs::Inputs,
    step::Run,
    steps::{self, ClustersStep, ShownStep, TwinsStep, UnaryStep, UnaryWithWarnings},
    visible_surface::VisibleSurface,
};
use crate::{
    base::{decimals::significant, large_pages, progress::Watcher},
    config::Settings,
    decision::{CountedPlaces, FinishedPart, PlacesRule, Tables},
    io::project::{ImageFaults, Project},
    method::{
        confidence::{Agreement, NO_AGREEMENT, Sharpness},
        fulfilment::{FulfilmentTable, Model},
        geometry::Geometry,
        partners::Candidates,
        pilot::{Places, Thumbnails},
        ranking::Objective,
        region::{Ground, Region},
        surface::{Surface, SurfaceStats},
        target::Target,
        twins::Twin,
        visibility::Shown,
    },
    model::{
        cluster::{MapScale, ViewCluster},
        georeference::Georeference,
        scene::{Scene, ViewIndex},
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
    /// Keys of settings that mean nothing for the backend, and count as not set.
    pub unfit: Vec<&'static str>,
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
        let mut inputs = Inputs::new(project, scene, settings, matcher, timings)?;
        let memory = Memory::before_surface(
            &inputs.scene,
            &mut inputs.settings,
            inputs.most_pixels,
            matcher.makes_maps,
            watcher,
        )?;
        let mut run = Run {
            timings,
            memory,
            watcher,
        };

        let twins = run.step(TwinsStep { inputs: &inputs })?;
        let (seen, candidates) = steps::surface_and_candidates(&inputs, &twins, &mut run)?;
        run.memory
            .before_partners(&inputs.scene, &seen.surface, &seen.visibility)?;

        let shown = run.step(ShownStep {
            inputs: &inputs,
            seen: &seen,
        })?;
        let (region, ground) = steps::region(&mut inputs, &twins, &seen, &shown, &mut run)?;
        let inputs = inputs;
        let target = target(&inputs, seen.gsd, &shown, region.as_ref());
        let objective = objective(&inputs, &seen.surface, &shown, region.as_ref());
        let geometry = Geometry {
            scene: &inputs.scene,
            surface: &seen.surface,
            visibility: &seen.visibility,
            target: &target,
            image_scale: inputs.settings.image_scale(),
        };
        seen.visibility.triangles.release();
        large_pages::return_freed_memory();

        let unary = run.step(UnaryStep {
            inputs: &inputs,
            surface_file: &seen.file,
            geometry,
        })?;
        let thumbnails = Thumbnails::new(inputs.scene.views.len());
        let compared = steps::agreement(&inputs, &geometry, &candidates, &thumbnails, &mut run)?;
        let agreement = compared.as_deref().unwrap_or(&NO_AGREEMENT);

        let clusters = run.step(ClustersStep {
            inputs: &inputs,
            from: [&seen.file, &candidates.file, &unary.file],
            agreement_file: compared.as_ref().map(|compared| &compared.file),
            model: Model::new(geometry, &unary.unary, agreement, inputs.rule()),
            candidates: &candidates,
        })?;
        large_pages::return_freed_memory();
        let support = objective.support;
        let places = steps::pilot(&inputs, &clusters, support, thumbnails, &mut run)?;

        let found = Found {
            twins,
            seen,
            candidates,
            shown,
            region,
            ground,
            target,
            objective,
            unary,
            agreement: compared,
            clusters,
            places,
        };
        let stages = found.into_stages(inputs, run.memory);
        watcher.check()?;
        Ok(stages)
    }

    /// Formats a ground sampling distance.
    pub fn gsd_in_words(&self, gsd: f64) -> String {
        let (unit, metres) = match self.metres {
            Some(metres) => ("m", metres),
            None => ("units", 1.0),
        };
        format!("{} {unit} per pixel", significant(gsd * metres))
    }

    /// Formats the wanted ground sampling distance, with that of areas of the region.
    pub fn wanted(&self) -> String {
        let said = |gsd: f64| significant(gsd * self.metres.unwrap_or(1.0));
        let of_areas = self.region.iter().flat_map(|region| &region.gsd);
        let of_areas = of_areas.copied().filter(|gsd| gsd.is_finite());
        let [finest, coarsest] = of_areas.fold([f32::INFINITY, 0.0], |[low, high], gsd| {
            [low.min(gsd), high.max(gsd)]
        });
        let of_areas = match [finest, coarsest].map(|gsd| said(gsd.into())) {
            _ if finest.is_infinite() => String::new(),
            [low, high] if low == high => format!(", {low} where the region says so"),
            [low, high] => format!(", {low} to {high} where the region says so"),
        };
        let gsd = self.settings.target.gsd.unwrap_or(f64::NAN);
        format!("{}{of_areas}", self.gsd_in_words(gsd))
    }

    /// The area of the region in numbers.
    pub fn ground_summary(&self) -> Option<GroundSummary> {
        let ground = self.ground.as_ref()?;
        let needed = self.settings.coverage.min_cameras;
        Some(GroundSummary::new(ground, true, needed))
    }

    /// Returns the stages with other clusters, their fulfilment, and that at half the size.
    /// `finished` returns what is measured of a view.
    pub fn with_clusters<'f>(
        self,
        clusters: Vec<ViewCluster>,
        fulfilment: FulfilmentTable,
        half: Option<FulfilmentTable>,
        finished: &dyn Fn(ViewIndex) -> Option<FinishedPart<'f>>,
    ) -> Self {
        let scale = self.settings.image_scale();
        let work = work(&self.scene, scale, self.per_map, &clusters);
        let predicted = (&fulfilment, half.as_ref());
        let pilot = self.pilot.as_ref();
        let pilot = pilot.map(|pilot| pilot.of_clusters(&clusters, predicted, finished));
        Self {
            tables: Tables {
                pilot,
                clusters,
                fulfilment,
                half,
                work,
                ..self.tables
            },
            known_ranking: None,
            ..self
        }
    }
}

impl std::ops::Deref for Stages {
    type Target = Tables;

    fn deref(&self) -> &Tables {
        &self.tables
    }
}

/// Results of the stages, each with its cache file.
struct Found {
    twins: Filed<Vec<Twin>>,
    seen: Filed<VisibleSurface>,
    candidates: Filed<Candidates>,
    shown: Filed<Shown>,
    region: Option<Region>,
    ground: Option<Ground>,
    target: Target,
    objective: Objective,
    unary: Filed<UnaryWithWarnings>,
    agreement: Option<Filed<Agreement>>,
    clusters: Filed<CachedClusters>,
    places: Option<Filed<Places>>,
}

impl Found {
    fn into_stages(mut self, inputs: Inputs, memory: Memory) -> Stages {
        let (pilot_file, places) = self.places.take().map(Filed::into_parts).unzip();
        let pilot = places.and_then(|places| self.counted(places, &inputs));
        let (scale, per_map) = (inputs.settings.image_scale(), inputs.matcher.numbers.work);
        let work = work(&inputs.scene, scale, per_map, &self.clusters.clusters);
        let ranking = self.known_ranking(pilot_file.as_ref(), &inputs, &work);

        let (agreement_file, agreement) = self.agreement.map(Filed::into_parts).unzip();
        let agreement = agreement.unwrap_or_default();
        let mut picture_warnings = self.unary.result.warnings;
        picture_warnings.extend(agreement.warnings.iter().cloned());
        let rule = inputs.rule();
        let mut without_image = inputs.without_image;
        without_image.extend(&agreement.rejected);
        without_image.sort_unstable();

        let seen = self.seen.result;
        let clusters = self.clusters.result;
        Stages {
            own_size: inputs.own_size,
            mixes_sizes: inputs.matcher.mixes_sizes,
            makes_maps: inputs.matcher.makes_maps,
            refused_half: inputs.refused_half,
            unfit: inputs.unfit,
            backend: inputs.matcher.name,
            image_gsd: inputs.image_gsd,
            place: inputs.place,
            metres: inputs.metres,
            ground: self.ground,
            image_faults: inputs.image_faults,
            settings: inputs.settings,
            surface_stats: seen.stats,
            picture_warnings,
            tables: Tables {
                scene: inputs.scene,
                surface: seen.surface,
                visibility: seen.visibility,
                shown: self.shown.result,
                region: self.region,
                target: self.target,
                without_image,
                kept_for_tests: inputs.kept_for_tests,
                twins: self.twins.result,
                candidates: self.candidates.result,
                unary: self.unary.result.unary,
                agreement,
                rule,
                objective: self.objective,
                clusters: clusters.clusters,
                fulfilment: clusters.fulfilment,
                half: clusters.half,
                pilot,
                work,
            },
            per_map,
            known_ranking: ranking.result,
            cached: Cached {
                twins: self.twins.file,
                surface: self.seen.file,
                shown: self.shown.file,
                candidates: self.candidates.file,
                unary: self.unary.file,
                agreement: agreement_file,
                clusters: self.clusters.file,
                pilot: pilot_file,
                ranking: ranking.file,
                made: None,
            },
            memory,
        }
    }

    /// Weighs the places of the pilot; `None` if none counts.
    fn counted(&self, places: Places, inputs: &Inputs) -> Option<CountedPlaces> {
        let agreement = self.agreement.as_deref().unwrap_or(&NO_AGREEMENT);
        let settings = &inputs.settings.ranking;
        let rule = PlacesRule {
            surface: &self.seen.surface,
            region: self.region.as_ref(),
            objective: &self.objective,
            weight: settings.weight,
            half_worth: settings.half_worth,
            sharpness: Sharpness::new(&inputs.scene, &agreement.detail),
        };
        let Filed { result, .. } = &self.clusters;
        CountedPlaces::new(
            Arc::new(places),
            &result.clusters,
            result.predicted(),
            &rule,
        )
    }

    /// Returns the ranking of an earlier plan that ranked the same.
    fn known_ranking(
        &self,
        pilot_file: Option<&ResultFile>,
        inputs: &Inputs,
        work: &[[f64; 2]],
    ) -> Filed<Option<UncutRanking>> {
        let from = pilot_file.unwrap_or(&self.clusters.file);
        let factors = self.region.as_ref().map(|region| &region.factors[..]);
        let file = inputs.fingerprints.ranking(
            &inputs.settings,
            &from.file,
            (&self.objective, inputs.matcher.makes_maps),
            factors,
            work,
        );
        let clusters = self.clusters.clusters.len();
        let triangles = self.seen.surface.triangles.len();
        cached::read(file, |(), bytes| {
            cached::ranking::unpack(bytes, clusters, triangles)
        })
    }
}

/// Returns the work of each cluster's map at full and at half size.
fn work(
    scene: &Scene,
    image_scale: f64,
    per_map: WorkPerMap,
    clusters: &[ViewCluster],
) -> Vec<[f64; 2]> {
    let of_cluster = |cluster: &ViewCluster| {
        let camera = scene.camera_of(cluster.key);
        let pixels = f64::from(camera.width) * f64::from(camera.height);
        let megapixels = pixels * image_scale.powi(2) / 1e6;
        [MapScale::Full, MapScale::Half].map(|scale| {
            per_map.map_work(megapixels * scale.factor().powi(2), cluster.partners.len())
        })
    };
    clusters.iter().map(of_cluster).collect()
}

/// Returns what is wanted of each triangle (method 3.6), with the wishes of the region.
fn target(inputs: &Inputs, gsd: f64, shown: &Shown, region: Option<&Region>) -> Target {
    let settings = &inputs.settings;
    let target = Target::new(shown, &settings.target, gsd, settings.image_scale());
    match region {
        Some(region) => target.with_wishes(region),
        None => target,
    }
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
