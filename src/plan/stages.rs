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
        surface::SurfaceStats,
        target::Target,
        twins::Twin,
        visibility::Shown,
    },
    model::{
        cluster::{MapScale, ViewCluster},
        georeference::Georeference,
        scene::{Scene, ViewIndex},
        surface::Surface,
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

        let wanted = Wanted::new(&mut inputs, &mut run)?;
        let predicted = Prediction::new(&inputs, &wanted, &mut run)?;
        let stages = Found { wanted, predicted }.into_stages(inputs, run.memory);
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
            // That of the earlier plan is of other clusters.
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

/// The surface, which view sees what of it, and what is wanted there (method 1, 2, 3.6 and 5.1).
struct Wanted {
    twins: Filed<Vec<Twin>>,
    seen: Filed<VisibleSurface>,
    candidates: Filed<Candidates>,
    shown: Filed<Shown>,
    region: Option<Region>,
    ground: Option<Ground>,
    target: Target,
    objective: Objective,
}

impl Wanted {
    fn new(inputs: &mut Inputs, run: &mut Run) -> Result<Self, PlanError> {
        let twins = run.step(TwinsStep { inputs })?;
        let (seen, candidates) = steps::surface_and_candidates(inputs, &twins, run)?;
        run.memory
            .before_partners(&inputs.scene, &seen.surface, &seen.visibility)?;
        let shown = run.step(ShownStep {
            inputs,
            seen: &seen,
        })?;
        let (region, ground) = steps::region(inputs, &twins, &seen, &shown, run)?;
        let target = target(inputs, seen.gsd, &shown, region.as_ref());
        let objective = objective(inputs, &seen.surface, &shown, region.as_ref());
        // The steps before have read all of it; the pages of a table on disk would stay in memory.
        seen.visibility.triangles.release();
        large_pages::return_freed_memory();
        Ok(Self {
            twins,
            seen,
            candidates,
            shown,
            region,
            ground,
            target,
            objective,
        })
    }

    fn geometry<'a>(&'a self, inputs: &'a Inputs) -> Geometry<'a> {
        Geometry {
            scene: &inputs.scene,
            surface: &self.seen.surface,
            visibility: &self.seen.visibility,
            target: &self.target,
            image_scale: inputs.settings.image_scale(),
        }
    }
}

/// The clusters, and what each is predicted to fulfil (method 3, 4, 7 and 5.9).
struct Prediction {
    unary: Filed<UnaryWithWarnings>,
    agreement: Option<Filed<Agreement>>,
    clusters: Filed<CachedClusters>,
    places: Option<Filed<Places>>,
}

impl Prediction {
    fn new(inputs: &Inputs, wanted: &Wanted, run: &mut Run) -> Result<Self, PlanError> {
        let (geometry, candidates) = (wanted.geometry(inputs), &wanted.candidates);
        let unary = run.step(UnaryStep {
            inputs,
            surface_file: &wanted.seen.file,
            geometry,
        })?;
        let thumbnails = Thumbnails::new(inputs.scene.views.len());
        let compared = steps::agreement(inputs, &geometry, candidates, &thumbnails, run)?;
        let agreement = compared.as_deref().unwrap_or(&NO_AGREEMENT);
        let clusters = run.step(ClustersStep {
            inputs,
            from: [&wanted.seen.file, &candidates.file, &unary.file],
            agreement_file: compared.as_ref().map(|compared| &compared.file),
            model: Model::new(geometry, &unary.unary, agreement, inputs.rule()),
            candidates,
        })?;
        large_pages::return_freed_memory();
        let support = wanted.objective.support;
        let places = steps::pilot(inputs, &clusters, support, thumbnails, run)?;
        Ok(Self {
            unary,
            agreement: compared,
            clusters,
            places,
        })
    }
}

/// Results of the stages, each with its cache file.
struct Found {
    wanted: Wanted,
    predicted: Prediction,
}

impl Found {
    fn into_stages(mut self, inputs: Inputs, memory: Memory) -> Stages {
        let places = self.predicted.places.take();
        let (pilot_file, places) = places.map(Filed::into_parts).unzip();
        let pilot = places.and_then(|places| self.counted(places, &inputs));
        let work = self.work(&inputs);
        let ranking = self.known_ranking(pilot_file.as_ref(), &inputs, &work);
        let cached = self.cached(pilot_file, ranking.file);

        let (agreement, picture_warnings) = self.take_agreement();
        let Self { wanted, predicted } = self;
        let rule = inputs.rule();
        // Pictures that could not be compared after all count as missing from here on.
        let without_image = sorted(inputs.without_image, &agreement.rejected);

        let seen = wanted.seen.result;
        let clusters = predicted.clusters.result;
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
            ground: wanted.ground,
            image_faults: inputs.image_faults,
            settings: inputs.settings,
            surface_stats: seen.stats,
            picture_warnings,
            tables: Tables {
                scene: inputs.scene,
                surface: seen.surface,
                visibility: seen.visibility,
                shown: wanted.shown.result,
                region: wanted.region,
                target: wanted.target,
                without_image,
                kept_for_tests: inputs.kept_for_tests,
                twins: wanted.twins.result,
                candidates: wanted.candidates.result,
                unary: predicted.unary.result.unary,
                agreement,
                rule,
                objective: wanted.objective,
                clusters: clusters.clusters,
                fulfilment: clusters.fulfilment,
                half: clusters.half,
                pilot,
                work,
            },
            per_map: inputs.matcher.numbers.work,
            known_ranking: ranking.result,
            cached,
            memory,
        }
    }

    /// Takes the agreement of the pictures out, and gives all warnings of pictures with it.
    fn take_agreement(&mut self) -> (Agreement, Vec<String>) {
        let agreement = self.predicted.agreement.take();
        let agreement = agreement.map_or_else(Default::default, |agreement| agreement.result);
        let mut warnings = std::mem::take(&mut self.predicted.unary.result.warnings);
        warnings.extend(agreement.warnings.iter().cloned());
        (agreement, warnings)
    }

    fn cached(&self, pilot: Option<ResultFile>, ranking: ResultFile) -> Cached {
        let Self { wanted, predicted } = self;
        let agreement = predicted.agreement.as_ref();
        Cached {
            twins: wanted.twins.file.clone(),
            surface: wanted.seen.file.clone(),
            shown: wanted.shown.file.clone(),
            candidates: wanted.candidates.file.clone(),
            unary: predicted.unary.file.clone(),
            agreement: agreement.map(|agreement| agreement.file.clone()),
            clusters: predicted.clusters.file.clone(),
            pilot,
            ranking,
            made: None,
        }
    }

    fn work(&self, inputs: &Inputs) -> Vec<[f64; 2]> {
        let (scale, per_map) = (inputs.settings.image_scale(), inputs.matcher.numbers.work);
        work(
            &inputs.scene,
            scale,
            per_map,
            &self.predicted.clusters.clusters,
        )
    }

    /// Weighs the places of the pilot; `None` if none counts.
    fn counted(&self, places: Places, inputs: &Inputs) -> Option<CountedPlaces> {
        let Self { wanted, predicted } = self;
        let agreement = predicted.agreement.as_deref().unwrap_or(&NO_AGREEMENT);
        let settings = &inputs.settings.ranking;
        let rule = PlacesRule {
            surface: &wanted.seen.surface,
            region: wanted.region.as_ref(),
            objective: &wanted.objective,
            weight: settings.weight,
            half_worth: settings.half_worth,
            sharpness: Sharpness::new(&inputs.scene, &agreement.detail),
        };
        let Filed { result, .. } = &predicted.clusters;
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
        let Self { wanted, predicted } = self;
        // The fingerprint of the pilot's file covers that of the clusters.
        let from = pilot_file.unwrap_or(&predicted.clusters.file);
        let factors = wanted.region.as_ref().map(|region| &region.factors[..]);
        let file = inputs.fingerprints.ranking(
            &inputs.settings,
            &from.file,
            &wanted.objective,
            inputs.matcher.makes_maps,
            factors,
            work,
        );
        let clusters = predicted.clusters.clusters.len();
        let triangles = wanted.seen.surface.triangles.len();
        cached::read(file, |(), bytes| {
            cached::ranking::unpack(bytes, clusters, triangles)
        })
    }
}

fn sorted(mut views: Vec<ViewIndex>, further: &[ViewIndex]) -> Vec<ViewIndex> {
    views.extend(further);
    views.sort_unstable();
    views
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
