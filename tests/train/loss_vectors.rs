//! Each loss and its derivatives against PyTorch's in f64 (`loss_vectors.py` wrote them).

use std::collections::BTreeMap;

use serde::Deserialize;
use wildcity_train::compose::{Background, Exposure, compose, compose_gradient};
use wildcity_train::loss::ground::{Gaussian, Terms};
use wildcity_train::loss::{
    DepthLoss, Loss, disparity, dssim, l1, l2, masked, metric_depth, normals, opacity, scale,
};

const SIZE_PX: [usize; 2] = [8, 6];

#[derive(Deserialize)]
struct Case {
    name: String,
    value: f64,
    inputs: BTreeMap<String, Vec<f64>>,
    /// The derivatives by some of the inputs.
    by: BTreeMap<String, Vec<f64>>,
}

/// What one of our losses gives: its value, and derivatives by inputs.
type Ours = (f64, Vec<(&'static str, Vec<f64>)>);

fn by_image(loss: Loss<f64>) -> Ours {
    (loss.value, vec![("image", loss.by)])
}

fn by_depth(loss: DepthLoss<f64>) -> Ours {
    (loss.value, vec![("opacity", loss.by_opacity), ("depth_sum", loss.by_depth_sum)])
}

fn triples(values: &[f64]) -> Vec<[f64; 3]> {
    values.as_chunks().0.to_vec()
}

impl Case {
    fn input(&self, name: &str) -> &[f64] {
        self.inputs.get(name).unwrap_or_else(|| panic!("{} has no input {name}", self.name))
    }

    fn ours(&self) -> Ours {
        let input = |name| self.input(name);
        match &*self.name {
            "l1" => by_image(l1(input("image"), input("target"), Some(input("weights")))),
            "l2" => by_image(l2(input("image"), input("target"), Some(input("weights")))),
            "masked dssim" => {
                let [image, target] =
                    ["image", "target"].map(|name| masked(input(name), input("weights")));
                let Loss { value, by } = dssim(SIZE_PX, &image, &target);
                (value, vec![("image", masked(&by, input("weights")))])
            }
            "disparity" => {
                by_depth(disparity(input("opacity"), input("depth_sum"), input("measured")))
            }
            "metric depth" => {
                by_depth(metric_depth(input("opacity"), input("depth_sum"), input("measured")))
            }
            "normals" => {
                let [rays, given] = ["rays", "given"].map(|name| triples(input(name)));
                let [opacity, depth_sum] = ["opacity", "depth_sum"].map(input);
                by_depth(normals(SIZE_PX, &rays, opacity, depth_sum, &given))
            }
            "opacity" => {
                let Loss { value, by } = opacity(input("values"));
                (value, vec![("values", by)])
            }
            "scale" => {
                let Loss { value, by } = scale(input("values"));
                (value, vec![("values", by)])
            }
            "compose" => self.composed(),
            name => self.ground(name.strip_prefix("ground: ").expect("a known loss")),
        }
    }

    fn ground(&self, term: &str) -> Ours {
        let weight = |name| if name == term { 1.0 } else { 0.0 };
        let [up, forward] = ["up", "forward"].map(|name| triples(self.input(name))[0]);
        let terms = Terms {
            up,
            forward,
            slice_m: 2.0,
            height: weight("height"),
            upright: weight("upright"),
            opaque: weight("opaque"),
        };
        let [means, normals] = ["mean", "normal"].map(|name| triples(self.input(name)));
        let gaussians: Vec<Gaussian<f64>> = means
            .into_iter()
            .zip(normals)
            .zip(self.input("opacity"))
            .map(|((mean_m, normal), &opacity)| Gaussian { mean_m, normal, opacity })
            .collect();
        let loss = terms.loss(&gaussians);
        let by_mean = loss.by.iter().flat_map(|by| by.mean_m).collect();
        let by_normal = loss.by.iter().flat_map(|by| by.normal).collect();
        let by_opacity = loss.by.iter().map(|by| by.opacity).collect();
        (loss.value, vec![("mean", by_mean), ("normal", by_normal), ("opacity", by_opacity)])
    }

    fn composed(&self) -> Ours {
        let [rgb, opacity, sky, by] = ["rgb", "opacity", "sky", "weights"].map(|k| self.input(k));
        let rows = triples(self.input("matrix"));
        let exposure = Exposure {
            matrix: [rows[0], rows[1], rows[2]],
            offset: triples(self.input("offset"))[0],
        };
        let sky = Background::Image(sky);
        let image = compose(rgb, opacity, sky, &exposure);
        let value = image.iter().zip(by).map(|(a, b)| a * b).sum();
        let gradient = compose_gradient(rgb, opacity, sky, &exposure, by);
        let derivatives = vec![
            ("rgb", gradient.rgb),
            ("opacity", gradient.opacity),
            ("sky", gradient.background),
            ("matrix", gradient.exposure.matrix.concat()),
            ("offset", gradient.exposure.offset.to_vec()),
        ];
        (value, derivatives)
    }
}

#[test]
fn losses_have_the_values_and_derivatives_of_pytorch() {
    let cases: Vec<Case> = serde_json::from_str(include_str!("loss_vectors.json")).expect("cases");
    assert_eq!(cases.len(), 12);
    for case in cases {
        let name = &case.name;
        let (value, derivatives) = case.ours();
        assert!((value - case.value).abs() < 1e-12, "{name}: {value} and not {}", case.value);
        for (input, theirs) in &case.by {
            let ours = derivatives.iter().find(|(name, _)| name == input);
            let (_, ours) = ours.unwrap_or_else(|| panic!("{name}: no derivative by {input}"));
            assert_eq!(ours.len(), theirs.len(), "{name}, {input}");
            let most = theirs.iter().fold(0.0_f64, |most, by| most.max(by.abs()));
            let off = ours.iter().zip(theirs).fold(0.0_f64, |off, (a, b)| off.max((a - b).abs()));
            assert!(off <= 1e-12 * most.max(1e-3), "{name}, {input}: {off:e} of {most:e}");
        }
    }
}
