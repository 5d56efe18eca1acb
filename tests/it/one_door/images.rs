//! Images are found by whatever their names mean.

use super::*;

/// The files of the first views, relative to the image folder.
fn files(folder: &Folder) -> Vec<Option<String>> {
    let project = folder.open();
    let scene = project.read_scene().unwrap();
    let images = project.images.clone().unwrap();
    let found = |view: &viewrank_core::model::scene::View| {
        let file = images.file(&view.name);
        let path = file.strip_prefix(folder.path()).unwrap();
        file.is_file()
            .then(|| path.to_str().unwrap().replace('\\', "/"))
    };
    scene.views.iter().map(found).collect()
}

fn assert_found(folder: &Folder, file: impl Fn(usize) -> String) {
    let mut expected: Vec<_> = (0..9).map(|n| Some(file(n))).collect();
    let mut found = files(folder);
    found.sort();
    expected.sort();
    assert_eq!(found, expected);
}

pub fn renamed(name: impl Fn(usize) -> String) -> ColmapModel<'static> {
    let mut scene = scene();
    for (n, view) in scene.views.iter_mut().enumerate() {
        view.name = name(n);
    }
    ColmapModel::from_scene(&scene)
}

#[test]
fn another_extension_or_case_is_found_in_folders_too() {
    let folder = Folder::new();
    let of = |n: usize| format!("Seq{}/{n}.JPG", n % 2);
    folder
        .colmap("sparse/0", &renamed(of))
        .pictures(&scene(), |name| {
            format!("seq{0}/{1}.png", number(name) % 2, number(name))
        });
    assert_found(&folder, |n| format!("seq{}/{n}.png", n % 2));
}

fn number(name: &str) -> usize {
    name.strip_prefix("view_")
        .unwrap()
        .strip_suffix(".png")
        .unwrap()
        .parse()
        .unwrap()
}

#[test]
fn a_path_from_the_current_folder_of_a_drive_is_found_without_the_drive() {
    let folder = Folder::new();
    folder
        .colmap(
            "sparse/0",
            &renamed(|n| match n {
                0 => "C:view_0.png".into(),
                n => format!("d:east\\view_{n}.png"),
            }),
        )
        .pictures(&scene(), |name| match name {
            "view_0.png" => "images/view_0.png".into(),
            name => format!("images/east/{name}"),
        });
    assert_found(&folder, |n| match n {
        0 => "images/view_0.png".into(),
        n => format!("images/east/view_{n}.png"),
    });
    assert!(names(&folder.read()).contains(&"view_0.png"));
}

#[test]
fn separators_of_windows_are_separators_where_files_say_so() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &renamed(|n| format!("east\\view_{n}.png")))
        .pictures(&scene(), |name| format!("images/east/{name}"));
    assert_found(&folder, |n| format!("images/east/view_{n}.png"));
    // A file that has a backslash in its name is meant by that.
    #[cfg(unix)]
    {
        let literal = Folder::new();
        literal
            .colmap("sparse/0", &renamed(|n| format!("east\\view_{n}.png")))
            .pictures(&scene(), |name| format!("images/east\\{name}"));
        assert_found(&literal, |n| format!("images/east/view_{n}.png"));
    }
    let (code, _, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 0, "{stderr}");
}

#[test]
fn an_absolute_windows_path_is_found_by_its_end() {
    let folder = Folder::new();
    folder
        .colmap(
            "sparse/0",
            &renamed(|n| format!("D:\\flights\\may\\east\\view_{n}.png")),
        )
        .pictures(&scene(), |name| format!("images/east/{name}"));
    assert_found(&folder, |n| format!("images/east/view_{n}.png"));
    let (code, _, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 0, "{stderr}");
}

#[test]
fn names_with_one_end_are_told_apart_by_their_folders() {
    let folder = Folder::new();
    let twice = |n: usize| format!("D:\\flight_{n}\\view_{}.png", n / 2);
    folder
        .colmap("sparse/0", &renamed(twice))
        .pictures(&scene(), |name| format!("images/{name}"));
    assert_eq!(names(&folder.read())[1], "flight_1/view_0.png");
}

#[test]
fn other_unicode_forms_are_the_same_name() {
    let folder = Folder::new();
    // As a model made on Linux and images copied from macOS.
    folder
        .colmap("sparse/0", &renamed(|n| format!("\u{e9}t\u{e9}_{n}.png")))
        .pictures(&scene(), |name| {
            format!("images/e\u{301}te\u{301}_{}.png", number(name))
        });
    assert_found(&folder, |n| format!("images/e\u{301}te\u{301}_{n}.png"));
}

#[test]
fn reduced_copies_are_taken_where_there_is_nothing_else() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    for factor in [8, 2] {
        folder.pictures(&scene(), |name| format!("images_{factor}/{name}"));
    }
    assert_found(&folder, |n| format!("images_2/view_{n}.png"));
    folder.pictures(&scene(), |name| format!("photos/{name}"));
    assert_found(&folder, |n| format!("photos/view_{n}.png"));
    folder.pictures(&scene(), |name| format!("images/{name}"));
    assert_found(&folder, |n| format!("images/view_{n}.png"));
}

/// Writes pictures of a colour and a size under the names of the views into a folder.
fn shots(folder: &Folder, place: &str, [width, height]: [u32; 2], colour: image::ColorType) {
    let picture = image::DynamicImage::new(width, height, colour);
    let mut png = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut png, image::ImageFormat::Png).unwrap();
    for view in &scene().views {
        folder.write(&format!("{place}/{}", view.name), png.get_ref());
    }
}

#[test]
fn photographs_come_before_their_masks_depths_and_reduced_copies() {
    use image::ColorType::{L8, L16, Rgb8};
    for (other, size, colour) in [
        ("depth", [100, 75], L16),
        ("annotations", [100, 75], Rgb8),
        ("nir", [100, 75], L8),
        ("lowres", [50, 38], Rgb8),
        ("enlarged", [200, 150], Rgb8),
    ] {
        let folder = Folder::new();
        folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
        shots(&folder, other, size, colour);
        shots(&folder, "photos", [100, 75], Rgb8);
        assert_found(&folder, |n| format!("photos/view_{n}.png"));
    }
}

#[test]
fn images_in_a_folder_beside_the_usual_one_are_found() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    let of = |n: usize| if n < 6 { "images" } else { "images2" };
    folder.pictures(&scene(), |name| format!("{}/{name}", of(number(name))));
    assert_found(&folder, |n| format!("{}/view_{n}.png", of(n)));
}

#[test]
fn what_cannot_be_read_says_nothing_of_a_folder() {
    let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n";
    for (unread, of) in [(1, 100), (9, 50)] {
        let folder = Folder::new();
        folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
        shots(&folder, "photos", [100, 75], image::ColorType::Rgb8);
        shots(&folder, "small", [of, of * 3 / 4], image::ColorType::Rgb8);
        for n in 0..unread {
            folder.write(&format!("photos/view_{n}.png"), pointer);
        }
        assert_found(&folder, |n| format!("photos/view_{n}.png"));
    }
}

#[test]
fn photographs_may_be_in_a_folder_whose_name_begins_like_that_of_results() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    shots(&folder, "Segovia", [100, 75], image::ColorType::Rgb8);
    shots(&folder, "seg", [100, 75], image::ColorType::Rgb8);
    assert_found(&folder, |n| format!("Segovia/view_{n}.png"));
}

#[test]
fn of_two_folders_that_look_the_same_the_other_is_named() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    shots(&folder, "first", [100, 75], image::ColorType::Rgb8);
    shots(&folder, "second", [100, 75], image::ColorType::Rgb8);
    assert_found(&folder, |n| format!("first/view_{n}.png"));
    shots(&folder, "grey", [100, 75], image::ColorType::L8);
    let warnings = folder.read().warnings;
    let is_said = |word: &str| warnings.iter().any(|warning| warning.text.contains(word));
    assert!(
        is_said("/first is taken") && is_said("/second") && is_said("/grey"),
        "{warnings:?}"
    );
}

#[test]
fn an_image_folder_of_other_pictures_is_not_the_one_that_is_meant() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    shots(&folder, "images", [50, 37], image::ColorType::Rgb8);
    assert_found(&folder, |n| format!("images/view_{n}.png"));
    shots(&folder, "originals", [100, 75], image::ColorType::Rgb8);
    assert_found(&folder, |n| format!("originals/view_{n}.png"));
}

#[test]
fn raw_pictures_are_for_the_programs_that_read_them() {
    let folder = Folder::new();
    let raw = renamed(|n| format!("view_{n}.CR2"));
    folder.colmap("sparse/0", &raw);
    for n in 0..9 {
        folder.write(&format!("images/view_{n}.CR2"), b"II*\0\x10\0\0\0CR\x02\0");
    }
    let (code, _, stderr) = folder.plan(&["--backend", "realityscan"]);
    assert_eq!(code, 0, "{stderr}");
    let (code, stdout, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("which view_0.CR2 is not"), "{stderr}");
    assert!(
        stdout.contains("Next: develop the raw pictures"),
        "{stdout}"
    );
    folder.pictures(&scene(), |name| {
        format!("developed/{}", name.replace("png", "JPG"))
    });
    let developed = folder.at("developed");
    let images = ["--images", developed.to_str().unwrap()];
    let (code, _, stderr) = folder.plan(&[&["--backend", "openmvs"], &images[..]].concat());
    assert_eq!(code, 0, "{stderr}");
}

#[test]
fn files_that_macos_hides_are_no_images_and_no_models() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("images/{name}"))
        .pictures(&scene(), |name| format!("images/._{name}"))
        .write("._scene.nvm", "Mac OS X")
        .write("sparse/0/._points.ply", "Mac OS X");
    let scene = folder.read();
    assert_eq!((scene.unregistered.len(), scene.warnings.len()), (0, 0));
}

#[test]
fn a_name_leads_to_the_parent_of_its_folder_and_no_further() {
    let frames: Vec<String> = (0..9)
        .map(|n| {
            format!(
                r#"{{"file_path":"../photos/view_{n}.png","transform_matrix":[[1,0,0,{n}],[0,1,0,0],[0,0,1,9]]}}"#
            )
        })
        .collect();
    let json = |up: &str| {
        let frames = frames.join(",").replace("../", up);
        format!(r#"{{"w":100,"h":75,"fl_x":85,"frames":[{frames}]}}"#)
    };
    let folder = Folder::new();
    folder
        .pictures(&scene(), |name| format!("photos/{name}"))
        .write("nerf/transforms.json", json("../"));
    let project = Project::open(&folder.at("nerf"), None).unwrap();
    assert_eq!(names(&project.read_scene().unwrap())[8], "view_8.png");
    assert!(project.images.unwrap().file("view_8.png").is_file());
    folder.write("nerf/transforms.json", json("../../"));
    let error = Project::open(&folder.at("nerf"), None)
        .unwrap()
        .read_scene()
        .unwrap_err();
    assert!(error.to_string().contains("outside"), "{error}");
}

#[test]
fn masks_are_named_as_by_colmap() {
    use viewrank_core::model::scene::ViewIndex;
    use viewrank_io::pictures::PictureFolders;
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &renamed(|n| format!("view_{n}.jpg")))
        .pictures(&scene(), |name| {
            format!("images/{}", name.replace(".png", ".JPG"))
        })
        .write("masks/view_0.jpg.png", "")
        .write("masks/view_1.png", "")
        .write("masks/view_2.JPG.png", "");
    let project = folder.open();
    let scene = project.read_scene().unwrap();
    let pictures = PictureFolders::new(&project);
    let has_mask = |view: u32| pictures.check_mask(&scene, ViewIndex(view)).is_some();
    assert_eq!([0, 1, 2, 3].map(has_mask), [true, true, true, false]);
    assert_eq!(pictures.stray_masks(&scene), Vec::<PathBuf>::new());
}

#[test]
fn the_image_path_of_colmaps_settings_is_one_more_place() {
    let elsewhere = Folder::new();
    elsewhere.pictures(&scene(), |name| format!("photos/{name}"));
    let absolute = elsewhere.at("photos");
    let inside = "a/b/c/d/photos";
    let paths = [
        (absolute.to_str().unwrap(), None),
        ("a/b/c/d/photos", Some(inside)),
        ("project/a/b/c/d/photos/", Some(inside)),
        ("..\\..\\a\\b\\c\\d\\photos", Some(inside)),
        ("D:\\survey\\project\\a\\b\\c\\d\\photos\\", Some(inside)),
        ("/home/ann/project/a/b/c/d/photos", Some(inside)),
    ];
    for (path, place) in paths {
        for settings in ["sparse/0/project.ini", "project.ini"] {
            let folder = Folder::new();
            folder
                .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
                .write(settings, format!("[Mapper]\nimage_path = {path}\n"));
            if let Some(place) = place {
                folder.pictures(&scene(), |name| format!("{place}/{name}"));
            }
            let project = folder.open();
            let read = project.read_scene().unwrap();
            assert_eq!(project.image_faults(&read).missing, [], "{path}");
        }
    }
}

#[test]
fn masks_beside_the_images_are_no_photographs() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &renamed(|n| format!("a/IMG_{n}.JPG")))
        .pictures(&scene(), |name| {
            let name = name.replace("view", "IMG").replace(".png", ".JPG");
            format!("images/a/{name}")
        });
    let masks = [
        "IMG_0_mask.png",
        "IMG_1.JPG.mask.png",
        "IMG_2.mask.png",
        "IMG_3.JPG.png",
        "IMG_4_MASK.JPG",
        "IMG_99_mask.JPG",
        "masks/IMG_5.png",
        "masks/IMG_6.JPG.png",
        "Mask/IMG_7_mask.png",
    ];
    for mask in masks {
        folder.write(&format!("images/a/{mask}"), "");
    }
    // The model lacks these.
    let photographs = [
        "IMG_100.JPG.png",
        "IMG_98_mask.JPG",
        "IMG_99.JPG",
        "mask.png",
    ];
    for name in photographs {
        folder.write(&format!("images/a/{name}"), "");
    }
    folder.write("images/b/masks/IMG_97.JPG", "");
    let mut expected: Vec<String> = photographs.map(|name| format!("a/{name}")).to_vec();
    expected.push("b/masks/IMG_97.JPG".into());
    assert_eq!(folder.read().unregistered, expected);
}

#[test]
fn the_matcher_gets_names_and_masks_as_they_were_found() {
    let folder = Folder::new();
    folder
        .colmap("colmap/sparse/0", &renamed(|n| format!("./view_{n}.jpg")))
        .pictures(&scene(), |name| format!("images/{name}"))
        .pictures(&scene(), |name| format!("masks/{name}"));
    let (code, _, stderr) = folder.plan(&["--backend", "sgm", "--budget", "9"]);
    assert_eq!(code, 0, "{stderr}");
    let same = |link: &str, file: &str| {
        let [link, file] = [link, file].map(|path| fs::read(folder.at(path)).unwrap());
        assert_eq!(link, file);
    };
    same("viewrank/sgm/images/view_4.jpg", "images/view_4.png");
    same("viewrank/sgm/masks/view_4.jpg.png", "masks/view_4.png");
    let copy = Project::open(&folder.at("viewrank/sgm"), None).unwrap();
    assert_eq!(names(&copy.read_scene().unwrap()), names(&folder.read()));
}

#[test]
fn names_that_lead_far_out_are_found_by_their_last_parts() {
    let folder = Folder::new();
    let mut model = ColmapModel::from_scene(&scene());
    for image in &mut model.images {
        image.name = format!("../../photos/{}", image.name).into();
    }
    folder
        .colmap("work/project/sparse/0", &model)
        .pictures(&scene(), |name| format!("elsewhere/photos/{name}"));
    let root = folder.at("work/project");
    let read = |project: Project| project.read_scene();
    let error = read(Project::open(&root, None).unwrap()).unwrap_err();
    let hint = viewrank_core::base::error::Hint::hint(&error).unwrap();
    assert!(hint.to_string().contains("with images: there"), "{hint}");
    for images in ["elsewhere", "elsewhere/photos"] {
        let project = Project::open(&root, None).unwrap();
        let project = project.with_images(Some(&folder.at(images)));
        let scene = read(project.clone()).unwrap();
        assert_eq!(project.image_faults(&scene).missing, [], "{images}");
    }
}

#[test]
fn names_of_another_program_that_lead_far_out_are_found_by_their_last_parts() {
    let folder = Folder::new();
    let frame = |n: usize| {
        format!(
            r#"{{"file_path":"../../photos/view_{n}.png","transform_matrix":[[1,0,0,{n}],[0,1,0,0],[0,0,1,9]]}}"#
        )
    };
    let frames: Vec<String> = (0..3).map(frame).collect();
    let frames = frames.join(",");
    folder
        .write(
            "a/b/transforms.json",
            format!(r#"{{"w":100,"h":75,"fl_x":85,"frames":[{frames}]}}"#),
        )
        .pictures(&scene(), |name| format!("photos/{name}"));
    let project = Project::open(&folder.at("a/b"), None).unwrap();
    assert!(project.read_scene().is_err());
    let project = project.with_images(Some(&folder.at("photos")));
    let scene = project.read_scene().unwrap();
    assert_eq!(names(&scene), ["view_0.png", "view_1.png", "view_2.png"]);
    assert_eq!(project.image_faults(&scene).missing, []);
}

#[test]
fn names_that_are_no_plain_paths_can_be_exported() {
    for (at, pattern) in [
        ("images", "./may//view_#.png"),
        ("images", "june/../may/view_#.jpg"),
        ("images", "May\\View_#.JPG"),
        ("images", "/home/ann/project/may/view_#.tif"),
        ("photos", "../photos/may/view_#.png"),
    ] {
        let name = |n: usize| pattern.replace('#', &n.to_string());
        let folder = Folder::new();
        folder
            .colmap("sparse/0", &renamed(name))
            .pictures(&scene(), |view| format!("{at}/may/{view}"))
            .write("images/notes.txt", "");
        let project = folder.open();
        let read = project.read_scene().unwrap();
        assert_eq!(project.image_faults(&read).missing, [], "{}", name(0));
        assert_eq!(read.unregistered, Vec::<String>::new(), "{}", name(0));
        for backend in ["openmvs", "colmap", "sgm", "splat", "realityscan"] {
            let out = folder.at(backend);
            let (code, _, stderr) =
                folder.plan(&["--backend", backend, "--out", out.to_str().unwrap()]);
            assert_eq!(code, 0, "{} for {backend}: {stderr}", name(0));
        }
    }
}

#[test]
fn masks_of_frames_are_used_wherever_they_are_below_the_file() {
    let folder = Folder::new();
    let frame = |(n, mask): (usize, &str)| {
        format!(
            r#"{{"file_path":"images/view_{n}.png"{mask},"transform_matrix":[[1,0,0,{n}],[0,1,0,0],[0,0,1,9],[0,0,0,1]]}}"#
        )
    };
    let masks = [
        r#","mask_path":"semantics/cut_0.png""#,
        r#","mask_path":".\\semantics\\cut_1.png""#,
        r#","mask_path":"../outside.png""#,
        r#","mask_path":"semantics/none.png""#,
        r#","mask_path":null"#,
        "",
    ];
    let frames: Vec<String> = masks.into_iter().enumerate().map(frame).collect();
    let frames = frames.join(",");
    folder
        .write(
            "project/transforms.json",
            format!(r#"{{"w":100,"h":75,"fl_x":85,"frames":[{frames}]}}"#),
        )
        .pictures(&scene(), |name| format!("project/images/{name}"))
        .write("outside.png", "")
        .write("project/masks/images/view_3.png", "");
    for n in 0..2 {
        folder.write(&format!("project/semantics/cut_{n}.png"), "");
    }
    folder.cloud("project/points3d.ply", &scene());
    let project = Project::open(&folder.at("project"), None).unwrap();
    let scene = project.read_scene().unwrap();
    let pictures = viewrank_io::pictures::PictureFolders::new(&project);
    let mask = |view: &viewrank_core::model::scene::View| pictures.mask_file(&view.name);
    let found: Vec<Option<PathBuf>> = scene.views.iter().map(mask).collect();
    let at = |name: &str| Some(folder.at("project").join(name));
    let expected = [
        at("semantics/cut_0.png"),
        at("semantics/cut_1.png"),
        None,
        at("masks/images/view_3.png"),
        None,
        None,
    ];
    assert_eq!(found, expected);
}
