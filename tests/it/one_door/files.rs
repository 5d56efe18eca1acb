//! Lists and links of exports name the files that were found, and what cannot be used is no export.

use super::{images::renamed, *};

/// Asserts that each line of the list of images is a file below the folder from which the command
/// copies, and returns the command.
fn assert_listed(folder: &Folder) -> String {
    let (code, stdout, stderr) = folder.plan(&["--backend", "images"]);
    assert_eq!(code, 0, "{stderr}");
    let export = folder.at("viewrank/images");
    let record: serde_json::Value =
        serde_json::from_slice(&fs::read(export.join("export.json")).unwrap()).unwrap();
    let command = record["commands"][0].as_str().unwrap().to_owned();
    let from = command.split(' ').nth(3).unwrap();
    let list = fs::read_to_string(export.join("images.txt")).unwrap();
    assert!(list.lines().count() > 1, "{stdout}");
    for file in list.lines() {
        let path = export.join(from).join(file);
        assert!(
            path.is_file() && !file.contains(".."),
            "{file} from {from} is {}",
            path.display()
        );
    }
    command
}

#[test]
fn a_list_of_images_names_the_files_that_were_found() {
    for (pattern, place) in [
        ("VIEW_#.PNG", "images"),
        ("view_#.png", "images/DCIM/100MEDIA"),
        ("view_#.jpg", "images"),
        ("./may//view_#.png", "images/may"),
    ] {
        let name = |n: usize| pattern.replace('#', &n.to_string());
        let folder = Folder::new();
        folder
            .colmap("sparse/0", &renamed(name))
            .pictures(&scene(), |view| format!("{place}/{view}"));
        let command = assert_listed(&folder);
        assert!(command.contains(" ../../images"), "{command}");
    }
}

#[test]
fn a_list_of_images_reaches_files_outside_of_their_folder() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &renamed(|n| format!("../photos/view_{n}.png")))
        .pictures(&scene(), |view| format!("photos/{view}"))
        .write("images/notes.txt", "");
    assert_listed(&folder);
}

#[test]
fn a_file_named_by_its_whole_path_is_in_the_folder() {
    let folder = Folder::new();
    let images = folder.at("images");
    let whole = |n: usize| images.join(format!("view_{n}.png")).display().to_string();
    folder
        .colmap("sparse/0", &renamed(whole))
        .pictures(&scene(), |view| format!("images/{view}"));
    let read = folder.read();
    assert_eq!(names(&read)[1], "view_1.png");
    assert_eq!(read.unregistered, Vec::<String>::new());
    assert_listed(&folder);
}

#[test]
fn side_files_of_realityscan_lie_beside_the_files() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &renamed(|n| format!("VIEW_{n}.JPG")))
        .pictures(&scene(), |view| format!("images/east/{view}"));
    let (code, _, stderr) = folder.plan(&["--backend", "realityscan"]);
    assert_eq!(code, 0, "{stderr}");
    let (export, images) = (
        folder.at("viewrank/realityscan"),
        folder.open().images.unwrap(),
    );
    for file in fs::read_to_string(export.join("xmp.txt")).unwrap().lines() {
        let image = file.replace(".xmp", ".png");
        assert!(images.join(image).is_file(), "{file}");
        assert!(export.join("xmp").join(file).is_file(), "{file}");
    }
}

#[test]
fn programs_that_go_by_extensions_get_those_of_the_files() {
    let spellings: [fn(usize) -> String; 2] =
        [|n| format!("view_{n}.tif"), |n| format!("view_{n}")];
    for name in spellings {
        let folder = Folder::new();
        folder
            .colmap("sparse/0", &renamed(name))
            .pictures(&scene(), |view| format!("images/{view}"));
        for backend in ["mve", "pmvs", "odm"] {
            let (code, _, stderr) = folder.plan(&["--backend", backend]);
            assert_eq!(code, 0, "{backend}: {stderr}");
        }
        let linked = |path: &str| folder.at(&format!("viewrank/{path}")).exists();
        assert!(linked("mve/views/view_00000001.mve/undistorted.png"));
        assert!(linked("pmvs/visualize/00000000.png"));
    }
}

#[test]
fn images_that_cannot_be_used_are_no_export_for_any_program() {
    let page = "<!DOCTYPE html><html></html>";
    let without = Folder::new();
    without.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    let (code, stdout, stderr) = without.plan(&["--backend", "splat"]);
    assert_eq!(code, 1, "{stdout}");
    assert!(stderr.contains("put the images into"), "{stderr}");
    for n in 0..9 {
        without.write(&format!("images/view_{n}.png"), page);
    }
    for backend in ["splat", "images", "realityscan"] {
        let (code, stdout, stderr) = without.plan(&["--backend", backend]);
        assert_eq!(code, 1, "{backend}: {stdout}");
        assert!(stderr.contains("web page"), "{stderr}");
        assert!(!stdout.contains("rsync"), "{stdout}");
    }
}

#[test]
fn two_files_that_fit_a_name_are_both_named() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &renamed(|n| format!("view_{n}.tif")))
        .pictures(&scene(), |view| format!("images/{view}"))
        .pictures(&scene(), |view| {
            format!("images/{}", view.replace("png", "jpg"))
        });
    let (code, stdout, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 1);
    for said in [&stdout, &stderr] {
        assert!(
            said.contains("two files fit view_0.tif (view_0.jpg and view_0.png)"),
            "{said}"
        );
    }
}

/// An image name of so many bytes.
fn of_length(length: usize, n: usize) -> String {
    format!("{n}{}.png", "x".repeat(length - 5))
}

#[test]
fn a_name_whose_results_no_folder_takes_is_refused_and_a_shorter_one_is_not() {
    for (backend, longest) in [("sgm", 250), ("colmap", 239)] {
        for length in [longest, longest + 1] {
            let folder = Folder::new();
            let number = |view: &str| view[5..6].parse::<usize>().unwrap();
            folder
                .colmap("sparse/0", &renamed(|n| of_length(length, n)))
                .pictures(&scene(), |view| {
                    format!("images/{}", of_length(length, number(view)))
                });
            let (code, _, stderr) = folder.plan(&["--backend", backend]);
            assert_eq!(code, i32::from(length > longest), "{stderr}");
            let is_refused = stderr.contains(&format!("{longest} bytes are the most"));
            assert_eq!(is_refused, length > longest, "{stderr}");
        }
    }
}

#[test]
fn two_images_of_one_file_are_an_error_of_the_model() {
    let by_whole_path = |folder: &Folder| folder.at("images/view_0.png").display().to_string();
    let spellings: [&dyn Fn(&Folder) -> String; 2] = [&|_| "./view_0.png".into(), &by_whole_path];
    for spelling in spellings {
        let folder = Folder::new();
        let other = spelling(&folder);
        let twice = |n: usize| match n {
            1 => other.clone(),
            n => format!("view_{n}.png"),
        };
        folder
            .colmap("sparse/0", &renamed(twice))
            .pictures(&scene(), |view| format!("images/{view}"));
        let root = folder.path().to_str().unwrap();
        for arguments in [
            &["plan", root, "--backend", "colmap"][..],
            &["doctor", root],
        ] {
            let (code, _, stderr) = said(&viewrank(arguments));
            assert_eq!(code, 1);
            assert!(stderr.contains("are one file"), "{stderr}");
            let names = ["\"view_0.png\"", &format!("{other:?}")];
            assert!(names.iter().all(|name| stderr.contains(*name)), "{stderr}");
        }
    }
}

#[test]
fn what_the_default_program_lacks_is_said_at_the_first_plan() {
    let folder = Folder::new();
    let mut model = ColmapModel::from_scene(&scene());
    let params = vec![85.0, 50.0, 37.5, 0.001];
    model.cameras[0] = Camera::new(1, CameraModel::SimpleRadial, 100, 75, params).unwrap();
    folder
        .colmap("sparse/0", &model)
        .pictures(&scene(), |name| format!("images/{name}"));
    let (code, stdout, stderr) = folder.plan(&[]);
    assert_eq!(code, 0, "{stderr}");
    assert!(
        stderr.contains("did not export to") && stderr.contains("needs undistorted images"),
        "{stderr}"
    );
    assert!(stdout.contains("Next: viewrank undistort"), "{stdout}");
}
