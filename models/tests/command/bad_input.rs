//! Bad input: one clear message, exit code 2, nothing half-written.

use crate::workplace::{Workplace, mentions, names, stderr};

#[test]
fn images_that_cannot_be_used() {
    let w = Workplace::new();
    mentions(&w.refuse(&["train", "tiny.toml", "--image", "no.png", "--out", "run"]), &["no.png", "cannot read"]);
    std::fs::write(w.path("corrupt.png"), b"\x89PNG\r\n\x1a\nnot really").unwrap();
    mentions(
        &w.refuse(&["train", "tiny.toml", "--image", "corrupt.png", "--out", "run"]),
        &["corrupt.png", "not a readable PNG or JPEG"],
    );
    std::fs::write(w.path("empty.jpg"), b"").unwrap();
    mentions(&w.refuse(&["train", "tiny.toml", "--image", "empty.jpg", "--out", "run"]), &["empty.jpg"]);
    image::RgbImage::new(11, 40).save(w.path("narrow.png")).unwrap();
    mentions(
        &w.refuse(&["train", "tiny.toml", "--image", "narrow.png", "--out", "run"]),
        &["11 x 40", "patches of 12 x 10"],
    );
    mentions(&w.refuse(&["train", "tiny.toml", "--image", ".", "--out", "run"]), &["cannot read"]);
    assert_eq!(w.left_behind(), ["corrupt.png", "empty.jpg", "narrow.png"]);
}

#[test]
fn presets_and_keys_that_do_not_exist() {
    let w = Workplace::new();
    mentions(&w.refuse(&["train", "planar-l2g-smal"]), &["planar-l2g-smal", "did you mean `planar-l2g-small`?"]);
    mentions(&w.refuse(&["explain", "planr-barf"]), &["did you mean `planar-barf`?"]);
    mentions(&w.refuse(&["train", "missing.toml"]), &["missing.toml"]);
    mentions(&w.refuse(&["train", "tiny.toml", "--data", "x"]), &["--data", "in the plane", "`--image`"]);
    mentions(&w.refuse(&["train", "space.toml", "--image", "x"]), &["--image", "in space", "`--data`"]);
    mentions(
        &w.refuse(&["train", "tiny.toml", "--set", "optim.lr_wrap=1"]),
        &["optim.lr_wrap", "did you mean `optim.lr_warp`?"],
    );
    std::fs::write(w.path("typo.toml"), "base = \"planar-l2g\"\n\n[data]\npatch_corp = [10, 10]\n").unwrap();
    mentions(
        &w.refuse(&["train", "typo.toml"]),
        &["typo.toml:4", "data.patch_corp", "did you mean `data.patch_crop`?"],
    );
    assert_eq!(w.left_behind(), ["typo.toml"]);
}

#[test]
fn values_of_the_wrong_type_or_range() {
    let w = Workplace::new();
    std::fs::write(w.path("type.toml"), "base = \"planar-l2g\"\n[optim]\nsteps = \"many\"\n").unwrap();
    mentions(&w.refuse(&["train", "type.toml"]), &["type.toml:3", "optim.steps", "expected a whole number"]);
    std::fs::write(w.path("syntax.toml"), "base = \"planar-l2g\"\n[optim\n").unwrap();
    mentions(&w.refuse(&["train", "syntax.toml"]), &["syntax.toml:2", "not valid TOML"]);
    std::fs::write(w.path("range.toml"), "base = \"planar-l2g\"\n[field]\n\nwindow = [0.5, 0.2]\n").unwrap();
    mentions(&w.refuse(&["train", "range.toml"]), &["range.toml:4", "field.window"]);
    for (args, expected) in [
        (["--set", "warp.dof=4"], "expected 1 (rotation), 2 (translation), 3 (rigid), 6 (pose) or 8 (homography)"),
        (["--set", "warp.dof=6"], "expected 1 (rotation), 2 (translation), 3 (rigid) or 8 (homography)"),
        (["--set", "warp.method=se3-field"], "moves cameras in space"),
        (["--set", "warp.activation=swish"], "expected one of"),
        (["--set", "field.kind=wavelet"], "expected one of"),
        (["--set", "loss.cycle=-1"], "a weight of 0 or more"),
        (["--set", "data.patch_crop=[11,12]"], "even number"),
        (["--set", "data.patch_crop=[10,40]"], "larger than the image"),
        (["--set", "optim.lr=-1"], "above 0"),
        (["--set", "warp.method=globl"], "expected one of"),
        (["--set", "steps"], "section.key=value"),
        (["--steps", "0"], "--steps 0"),
        (["--steps", "-5"], "--steps"),
        (["--seed", "x"], "--seed x"),
        (["--threads", "0"], "--threads 0"),
        (["--device", "gpu"], "`raygrad devices` lists them"),
    ] {
        let joined = args.join("=");
        let args = if args[0] == "--set" {
            vec!["train", "tiny.toml", args[0], args[1]]
        } else {
            vec!["train", "tiny.toml", &joined]
        };
        mentions(&w.refuse(&args), &[expected]);
    }
    assert_eq!(w.left_behind(), ["range.toml", "syntax.toml", "type.toml"]);
}

#[test]
fn invertible_warps_that_do_not_fit() {
    let w = Workplace::new();
    let settings = "base = \"tiny.toml\"\n[warp]\nmethod = \"invertible\"\n";
    for (more, expected) in [
        ("[warp.inn]\nblocks = 0\n", ["mine.toml:5", "`warp.inn.blocks`: expected 1 to 64, found 0"]),
        ("[warp.inn]\nanneal = \"channels\"\nanneal_steps = 0\n", ["mine.toml:6", "expected 1 or more, found 0"]),
        ("code = 5\n[warp.inn]\ncode = \"posenc\"\n", ["mine.toml:4", "expected an even number, found 5"]),
        ("[warp.inn]\ntrain_network = false\ntrain_code = false\n", ["mine.toml:5", "nothing of the warp is trained"]),
        ("[warp.inn]\nblock = 2\n", ["mine.toml:5", "did you mean `warp.inn.blocks`?"]),
    ] {
        std::fs::write(w.path("mine.toml"), format!("{settings}{more}")).unwrap();
        mentions(&w.refuse(&["train", "mine.toml", "--out", "run"]), &expected);
    }
    assert_eq!(w.left_behind(), ["mine.toml"]);
}

#[test]
fn a_device_that_is_not_there() {
    let w = Workplace::new();
    mentions(
        &w.refuse(&["train", "tiny.toml", "--precision", "double", "--out", "run"]),
        &["--precision", "run.precision", "`f32` or `mixed`"],
    );
    mentions(&w.refuse(&["train", "tiny.toml", "--device", "wgpu:99", "--out", "run"]), &["error:"]);
    mentions(&w.refuse(&["train", "tiny.toml", "--device", "vulkan:99", "--out", "run"]), &["error:"]);
    mentions(
        &w.refuse(&["train", "tiny.toml", "--device", "vulkan:x", "--out", "run"]),
        &["`auto`, `cpu`, `wgpu`, `vulkan`, `wgpu:N` or `vulkan:N`, found `vulkan:x`"],
    );
    assert!(w.left_behind().is_empty());
}

#[test]
fn perturbations_of_another_size() {
    let w = Workplace::new();
    w.succeed(&["train", "tiny.toml", "--steps", "1", "--out", "run"]);
    let other = "run/perturbation.json";
    let refuse = |more: &[&str]| {
        let args = [&["train", "tiny.toml", "--perturbation", other, "--out", "second"], more].concat();
        w.refuse(&args)
    };
    mentions(
        &refuse(&["--set", "data.image_size=[48,64]"]),
        &["images of 24 x 32", "has 48 x 64", "data.image_size=[24,32]"],
    );
    mentions(&refuse(&["--set", "data.patch_crop=[8,12]"]), &["patches of 10 x 12", "has 8 x 12"]);
    mentions(&refuse(&["--set", "data.patches=5"]), &["number of patches of 3", "has 5"]);
    mentions(&w.refuse(&["train", "tiny.toml", "--perturbation", "none.json"]), &["none.json"]);
    let text = std::fs::read_to_string(w.path(other)).unwrap();
    std::fs::write(w.path("bad.json"), text.replace("rotation\":", "rotatoin\":")).unwrap();
    mentions(
        &w.refuse(&["train", "tiny.toml", "--perturbation", "bad.json"]),
        &["bad.json", "missing field `rotation`"],
    );
    assert_eq!(w.left_behind(), ["bad.json", "run"]);
}

#[test]
fn folders_that_hold_something_else() {
    let w = Workplace::new();
    w.succeed(&["train", "tiny.toml", "--steps", "1", "--out", "run"]);
    let before = names(&w.path("run"));
    mentions(&w.refuse(&["train", "tiny.toml", "--steps", "1", "--out", "run"]), &["another run", "--resume"]);
    mentions(
        &w.refuse(&["train", "tiny.toml", "--steps", "2", "--out", "run"]),
        &["another run", "there `optim.steps` is 1, here 2"],
    );
    mentions(&w.refuse(&["train", "tiny.toml", "--steps", "2", "--out", "run", "--resume"]), &["optim.steps"]);
    mentions(&w.refuse(&["train", "tiny.toml", "--out", "nowhere", "--resume"]), &["nothing to resume"]);
    std::fs::create_dir(w.path("thesis")).unwrap();
    std::fs::write(w.path("thesis/chapter.tex"), "text").unwrap();
    mentions(&w.refuse(&["train", "tiny.toml", "--out", "thesis"]), &["not empty and holds no raygrad run"]);
    mentions(&w.refuse(&["train", "tiny.toml", "--out", "tiny.toml"]), &["not a folder"]);
    mentions(&w.refuse(&["train", "tiny.toml", "--out", "tiny.toml/run"]), &["tiny.toml/run"]);
    assert_eq!(names(&w.path("run")), before);
    assert_eq!(w.left_behind(), ["run", "thesis"]);
}

#[test]
fn checkpoints_that_are_damaged_or_foreign() {
    let w = Workplace::new();
    w.succeed(&["train", "tiny.toml", "--out", "run"]);
    let resume = || w.refuse(&["train", "tiny.toml", "--out", "run", "--resume"]);
    let tensors = w.path("run/checkpoint-0000012.safetensors");
    let bytes = std::fs::read(&tensors).unwrap();
    std::fs::write(&tensors, &bytes[..bytes.len() / 2]).unwrap();
    mentions(&resume(), &["damaged", &format!("expected {} bytes", bytes.len())]);
    let mut flipped = bytes.clone();
    *flipped.last_mut().unwrap() ^= 1;
    std::fs::write(&tensors, flipped).unwrap();
    mentions(&resume(), &["damaged", "digest"]);
    std::fs::remove_file(&tensors).unwrap();
    mentions(&resume(), &["checkpoint-0000012.safetensors"]);
    std::fs::write(w.path("run/checkpoint.json"), "{\"model\": \"resnet\"}").unwrap();
    mentions(&resume(), &["not a checkpoint of raygrad"]);
    std::fs::remove_file(w.path("run/checkpoint.json")).unwrap();
    mentions(&resume(), &["checkpoint.json"]);
}

/// A limit on file sizes fails in the same place as a full disk.
#[cfg(unix)]
#[test]
fn a_disk_that_takes_no_more() {
    let w = Workplace::new();
    let limited = |kilobytes: usize, args: &str| {
        let script = format!("trap '' XFSZ; ulimit -f {kilobytes}; exec \"$0\" {args}");
        let mut bash = std::process::Command::new("bash");
        bash.args(["-c", &script, env!("CARGO_BIN_EXE_raygrad")]).current_dir(w.path(".")).output().unwrap()
    };
    // Not even the settings and patches fit: as if the command had never run.
    let output = limited(1, "train tiny.toml --out a/run");
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    mentions(&stderr(&output), &["cannot write", "a/run/"]);
    assert!(w.left_behind().is_empty(), "{:?}", w.left_behind());
    // The first checkpoint does not fit: what was there before stays whole, and no temporary file is left.
    let output = limited(16, "train tiny.toml --set warp.code=600 --out run");
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    mentions(&stderr(&output), &["cannot write", ".safetensors"]);
    let left = names(&w.path("run"));
    assert!(left.iter().all(|n| !n.starts_with(".raygrad") && !n.starts_with("checkpoint")), "{left:?}");
}
