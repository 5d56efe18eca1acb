use nalgebra::Vector3;

use super::*;
use crate::{
    base::progress::NoWatcher,
    config::{ConfidenceSource, TargetSettings},
    method::synthetic::{SeenTown, Town},
};

/// Views at once, and the forecast, for pictures of a megapixel.
fn pictures(town: &SeenTown, limit: Option<u64>) -> Result<(SampleRoom, Memory), PlanError> {
    let mut settings = Settings {
        max_memory: limit.map(Bytes),
        ..Settings::default()
    };
    let mut memory =
        Memory::before_surface(&town.scene, &mut settings, 1_000_000, true, &NoWatcher)?;
    let room = memory.before_pictures(&town.geometry(1.0), 0)?;
    Ok((room, memory))
}

fn town(keep: Storage) -> SeenTown {
    Town {
        edge: 1.0,
        ..Town::default()
    }
    .seen(&TargetSettings::default(), 0.05, keep)
}

#[test]
fn a_limit_lets_fewer_pictures_be_sampled_at_once_but_not_none() {
    let town = town(Storage::Memory);
    let at_once = |limit| pictures(&town, Some(limit)).map(|(room, _)| room.views_at_once as u64);
    let (room, memory) = pictures(&town, None).unwrap();
    let (most, need) = (room.views_at_once as u64, memory.confidence);
    let wanted = VIEWS_PER_THREAD * rayon::current_num_threads() as u64;
    assert_eq!(
        most,
        wanted
            .min(column::READ_AT_ONCE as u64)
            .min(town.scene.views.len() as u64)
    );
    let samples = SAMPLES_ROW * town.visibility.triangles.len() as u64;
    // By bisection: the least limit that is enough for a single picture.
    let (mut too_little, mut enough) = (0, need + 8 * samples);
    while enough - too_little > 1 {
        let middle = (too_little + enough) / 2;
        if at_once(middle).is_ok() {
            enough = middle
        } else {
            too_little = middle
        }
    }
    assert_eq!(at_once(enough).unwrap(), 1);
    assert!(matches!(at_once(too_little), Err(PlanError::Memory { .. })));
    let more: Vec<u64> = (0..20)
        .map(|step| at_once(enough + step * samples).unwrap())
        .collect();
    assert!(more.is_sorted() && more[19] == most, "{more:?}");
}

#[test]
fn a_limit_lets_fewer_masks_be_read_at_once_but_not_none() {
    const OF_MASK: u64 = 5_000_000;
    let town = town(Storage::Memory);
    let masks = |limit: Option<u64>| {
        let mut settings = Settings {
            max_memory: limit.map(Bytes),
            ..Settings::default()
        };
        let mut memory = Memory::before_surface(&town.scene, &mut settings, 0, true, &NoWatcher)?;
        let views_at_once = memory.before_masks(&town.geometry(1.0), OF_MASK)?;
        Ok::<_, PlanError>((views_at_once, memory.confidence))
    };
    let pool = |threads| {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap()
    };
    let (views_at_once, for_one) = pool(1).install(|| masks(None)).unwrap();
    assert_eq!(views_at_once, column::READ_AT_ONCE, "one thread");
    pool(4).install(|| {
        let (views_at_once, for_four) = masks(None).unwrap();
        assert_eq!(views_at_once, column::READ_AT_ONCE);
        assert!(for_four - for_one >= 3 * OF_MASK);
        assert_eq!(
            masks(Some(for_four)).unwrap(),
            (column::READ_AT_ONCE, for_four)
        );
        assert_eq!(masks(Some(for_four - 1)).unwrap(), (3, for_four - OF_MASK));
        assert_eq!(
            masks(Some(for_four - 3 * OF_MASK)).unwrap(),
            (1, for_four - 3 * OF_MASK)
        );
        assert!(matches!(
            masks(Some(for_four - 3 * OF_MASK - 1)),
            Err(PlanError::Memory { stage: MASKS, .. })
        ));
    });
}

#[test]
fn samples_take_memory_only_where_they_are_kept() {
    let [in_memory, on_disk] = [Storage::Memory, Storage::Disk].map(town);
    let samples = SAMPLES_ROW * in_memory.visibility.triangles.len() as u64;
    let (room, memory) = pictures(&in_memory, None).unwrap();
    assert_eq!((room.keep, memory.disk), (Storage::Memory, 0));
    // They follow the other tables.
    let (room, with_tables) = pictures(&on_disk, None).unwrap();
    assert_eq!(room.keep, Storage::Disk);
    assert!(memory.confidence - with_tables.confidence > samples);
    // They go to disk alone above an eighth of the limit.
    let (room, alone) = pictures(&in_memory, Some(8 * samples)).unwrap();
    assert_eq!((room.keep, alone.disk), (Storage::Memory, 0));
    let (room, alone) = pictures(&in_memory, Some(8 * samples - 1)).unwrap();
    assert_eq!((room.keep, alone.disk), (Storage::Disk, samples));
}

#[test]
fn a_limit_that_is_too_small_for_the_surface_is_answered_with_one_for_all_pictures() {
    let town = town(Storage::Memory);
    let refused = |pixels, source| {
        let mut settings = Settings {
            max_memory: Some(Bytes(1)),
            ..Settings::default()
        };
        settings.confidence.source = source;
        match Memory::before_surface(&town.scene, &mut settings, pixels, true, &NoWatcher) {
            Err(PlanError::Memory {
                stage: SURFACE,
                need,
                with_pictures,
                ..
            }) => [need, with_pictures],
            other => panic!("{other:?}"),
        }
    };
    let [alone, advised] = refused(100_000_000, ConfidenceSource::Geometric);
    assert_eq!(alone, advised);
    // The thumbnails of the pilot come on top of what was read.
    let small = refused(1000, ConfidenceSource::Photometric);
    assert!(small[0] == alone && small[1] > alone, "{small:?}");
    let large = refused(100_000_000, ConfidenceSource::Photometric);
    assert!(
        large[0] == small[0] && large[1] > small[1] + 700_000_000,
        "{large:?}"
    );
}

#[test]
fn an_overview_counts_in_the_rows_of_the_view_that_sees_most() {
    let SeenTown {
        mut scene, surface, ..
    } = town(Storage::Memory);
    let before = Rows::expected(&scene, &surface);
    let few = scene.views.len();
    scene.views = scene.views.iter().cloned().cycle().take(8 * few).collect();
    let not_sampled = 1;
    let pose = &mut scene.views[not_sampled].cam_from_world;
    let high_above = pose.centre().coords + Vector3::z() * 300.0;
    pose.translation = -(pose.rotation * high_above);
    let after = Rows::expected(&scene, &surface);
    assert!(
        after.most > before.most && after.most as usize > surface.triangles.len() / 3,
        "{after:?} {before:?}"
    );
}

#[test]
fn images_ranked_by_what_they_draw_need_memory_for_what_they_show() {
    let SeenTown {
        scene,
        surface,
        visibility,
        ..
    } = town(Storage::Memory);
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let forecast = |makes_maps| {
        let mut settings = Settings::default();
        settings.partners.candidates = 1;
        let mut memory =
            Memory::before_surface(&scene, &mut settings, 0, makes_maps, &NoWatcher).unwrap();
        memory
            .before_partners(&scene, &surface, &visibility)
            .unwrap();
        memory.partners
    };
    let (of_maps, of_images) = one_thread
        .unwrap()
        .install(|| (forecast(true), forecast(false)));
    let rows = visibility.triangles.len() as u64;
    assert!(
        of_images > of_maps && of_images - of_maps < 60 * rows,
        "{of_maps} {of_images} {rows}"
    );
}

/// Permits a number of bytes.
struct Permits(u64);

impl Watcher for Permits {
    fn progress(&self, _: crate::base::progress::Stage, _: u64, _: u64) {}

    fn most_memory(&self) -> Option<u64> {
        Some(self.0)
    }
}

#[test]
fn what_a_run_may_take_refuses_but_changes_nothing() {
    let SeenTown {
        scene,
        surface,
        visibility,
        ..
    } = town(Storage::Memory);
    // Partners take most with a small buffer, visibility with a large one.
    let peaks = [16, 4096].map(|buffer_px| {
        let original = Settings {
            visibility: VisibilitySettings {
                buffer_px,
                ..VisibilitySettings::default()
            },
            ..Settings::default()
        };
        let after_all = |most| {
            let mut settings = original.clone();
            let mut memory =
                Memory::before_surface(&scene, &mut settings, 0, true, &Permits(most))?;
            let keep = memory.before_visibility(&scene, &surface, &settings.visibility)?;
            memory.before_partners(&scene, &surface, &visibility)?;
            assert_eq!((settings, keep), (original.clone(), Storage::Memory));
            Ok(memory)
        };
        let peak = after_all(u64::MAX).unwrap().peak();
        let refused = after_all(peak - 1);
        assert!(
            matches!(refused, Err(PlanError::Refused { .. })),
            "{refused:?}"
        );
        after_all(peak).unwrap()
    });
    assert!(
        peaks[0].peak() > peaks[0].visibility && peaks[1].peak() == peaks[1].visibility,
        "{peaks:?}"
    );
}

#[test]
fn a_limit_that_is_enough_is_easily_read() {
    let cases = [
        (100, "110M"),
        (112, "120M"),
        (195, "210M"),
        (970, "1.1G"),
        (2048, "2.2G"),
        (40_000, "41.1G"),
    ];
    cases
        .into_iter()
        .for_each(|(need, limit)| assert_eq!(enough(need << 20), limit));
    assert!(
        (1..5000u64).all(
            |mebibytes| enough(mebibytes << 20).parse::<Bytes>().unwrap().0 >= mebibytes << 20
        )
    );
}
