"""The graph of Difix: against diffusers, peft and onnxruntime, with tiny widths and random weights.

`oracle` states Difix once more with the classes of diffusers, as NVIDIA's pipeline does. PyTorch and diffusers are
large, so the gate does not install them. No published weights were here: what these tests cannot show is that the
folder of nvidia/difix_ref is what they assume. The exporter refuses another one, with the name of the tensor.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from test_difix import UNET, VAE, check
from wildcity import export_difix
from wildcity.difix_config import ExportError, Step, UnetConfig, VaeConfig

pytest.importorskip("torch", reason="PyTorch is optional: pip install 'wildcity[difix]' diffusers peft")
for package in ("blake3", "diffusers", "onnx", "peft", "transformers"):
    pytest.importorskip(package, reason="large, as PyTorch is: pip install 'wildcity[difix]' diffusers peft")

import diffusers  # noqa: E402
import difix_doubles  # noqa: E402
import peft  # noqa: E402
import torch  # noqa: E402
from safetensors.torch import load_file, save_file  # noqa: E402
from wildcity import difix_weights  # noqa: E402
from wildcity.difix_blocks import Attention  # noqa: E402
from wildcity.difix_graph import Difix  # noqa: E402

Session = onnxruntime.InferenceSession
TOLERANCE = 1e-4


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return difix_doubles.write_folder(tmp_path_factory.mktemp("difix") / "weights")


@pytest.fixture(scope="module")
def exported(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The manifest of the graph with reference, in f32."""
    out = tmp_path_factory.mktemp("exported") / "difix_ref.onnx"
    return export_difix.export(weights, out, dtype="f32", providers=["cpu"])


@pytest.fixture(scope="module")
def alone(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The manifest of the graph without reference, in f32."""
    out = tmp_path_factory.mktemp("alone") / "difix.onnx"
    return export_difix.export(weights, out, dtype="f32", reference=False)


def session(manifest: Path) -> Session:
    return Session(manifest.with_suffix(".onnx"), providers=["CPUExecutionProvider"])


def at_8192_pixels(manifest: Path) -> Path:
    """A copy of a manifest that asks for small images, beside it: at 1024 x 576 a check takes a minute."""
    content = json.loads(manifest.read_text())
    content["size"]["pixels"] = 8192
    copy = manifest.with_name("small.json")
    copy.write_text(json.dumps(content))
    return copy


def images(batch: int, height: int, width: int, seed: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    """Images and references, -1 to 1: noise that has large and small structures."""
    generator = torch.Generator().manual_seed(seed)

    def noise(cell: int) -> torch.Tensor:
        coarse = torch.rand(2 * batch, 3, height // cell, width // cell, generator=generator) * 2 - 1
        return torch.nn.functional.interpolate(coarse, (height, width), mode="nearest")

    image, reference = ((noise(32) + noise(8) + noise(1)) / 2).clamp(-1, 1).chunk(2)
    return image, reference


# --- diffusers


class TogetherProcessor:
    """Self-attention over the tokens of both views, as an attention processor of diffusers."""

    def __call__(self, attention: Any, hidden_states: torch.Tensor, *rest: Any, **named: Any) -> torch.Tensor:
        views, tokens, width = hidden_states.shape
        together = torch.cat([hidden_states[0::2], hidden_states[1::2]], 1)
        plain = diffusers.models.attention_processor.AttnProcessor()
        result = plain(attention, together, *rest, **named)
        apart = torch.stack([result[:, :tokens], result[:, tokens:]], 1)
        return apart.reshape(views, tokens, width)


def oracle(weights: Path) -> Callable[..., torch.Tensor]:
    """Difix made of diffusers' and peft's classes: NVIDIA's steps, with the mean in place of a sample."""
    skips = [(24, 24), (16, 24), (8, 24), (8, 16)]
    config = json.loads((weights / "vae" / "config.json").read_text())
    known = {key: value for key, value in config.items() if key not in ("gamma", "ignore_skip", "lora_rank")}
    vae = diffusers.AutoencoderKL.from_config(known)
    for at, (narrow, wide) in enumerate(skips):
        setattr(vae.decoder, f"skip_conv_{at + 1}", torch.nn.Conv2d(narrow, wide, 1, bias=False))
    ends = (*difix_doubles.ADAPTED, "skip_conv_1", "skip_conv_2", "skip_conv_3", "skip_conv_4")
    layers = [name for name, _ in vae.named_modules() if "decoder" in name and name.endswith(ends)]
    vae.add_adapter(peft.LoraConfig(r=config["lora_rank"], target_modules=layers), adapter_name="vae_skip")
    # Strict: every name that the double has is one that peft makes.
    vae.load_state_dict(load_file(weights / "vae" / "diffusion_pytorch_model.safetensors"))
    unet = diffusers.UNet2DConditionModel.from_config(json.loads((weights / "unet" / "config.json").read_text()))
    unet.load_state_dict(load_file(weights / "unet" / "diffusion_pytorch_model.safetensors"))
    scheduler = diffusers.DDPMScheduler.from_pretrained(weights, subfolder="scheduler")
    vae.eval(), unet.eval()
    prompt = difix_weights.prompt_embedding(weights)

    @torch.no_grad()
    def repair(image: torch.Tensor, reference: torch.Tensor | None = None) -> torch.Tensor:
        views = [image] if reference is None else [image, reference]
        processors = {
            name: TogetherProcessor() if name.endswith("attn1.processor") and len(views) == 2 else processor
            for name, processor in unet.attn_processors.items()
        }
        unet.set_attn_processor(processors)
        repaired = []
        # One image at a time: [image, reference] is the batch.
        for at in range(len(image)):
            x = torch.stack([view[at] for view in views])
            held: list[torch.Tensor] = []
            hooks = [
                block.register_forward_pre_hook(lambda _, given: held.append(given[0]))
                for block in vae.encoder.down_blocks
            ]
            latent = vae.encode(x).latent_dist.mode() * vae.config.scaling_factor
            for hook in hooks:
                hook.remove()
            scheduler.set_timesteps(timesteps=[199])
            noise = unet(latent, scheduler.timesteps[0], encoder_hidden_states=prompt.repeat(len(x), 1, 1)).sample
            latent = scheduler.step(noise, scheduler.timesteps[0], latent).prev_sample
            decoder = vae.decoder
            y = decoder.mid_block(decoder.conv_in(vae.post_quant_conv(latent / vae.config.scaling_factor)))
            held = [skip * config["gamma"] for skip in held]
            y = decoder.up_blocks[0](y + decoder.skip_conv_1(held[3]))
            y = decoder.up_blocks[1](y + decoder.skip_conv_2(held[2]))
            y = decoder.up_blocks[2](y + decoder.skip_conv_3(held[1]))
            y = decoder.up_blocks[3](y + decoder.skip_conv_4(held[0]))
            y = decoder.conv_out(decoder.conv_act(decoder.conv_norm_out(y)))
            repaired.append(y.clamp(-1, 1)[0])
        return torch.stack(repaired)

    repair.unet = unet  # type: ignore[attr-defined]
    repair.vae = vae  # type: ignore[attr-defined]
    return repair


def test_the_tensors_of_sd_turbo_have_these_names_and_shapes() -> None:
    with torch.device("meta"):
        ours = Difix(VaeConfig.read(VAE), UnetConfig.read(UNET), Step(1.0, 0.0), True)
        vae = diffusers.AutoencoderKL.from_config(
            {key: VAE[key] for key in VAE if key not in ("gamma", "ignore_skip", "lora_rank")}
        )
        unet = diffusers.UNet2DConditionModel.from_config(UNET)
        theirs = {f"vae.{name}": values.shape for name, values in vae.state_dict().items()}
        theirs |= {f"unet.{name}": values.shape for name, values in unet.state_dict().items()}
    # src/model.py of nv-tlabs/Difix3D.
    for at, (before, after) in enumerate([(512, 512), (256, 512), (128, 512), (128, 256)]):
        theirs[f"vae.decoder.skip_conv_{at + 1}.weight"] = torch.Size([after, before, 1, 1])
    assert {name: values.shape for name, values in ours.state_dict().items()} == theirs
    assert sum(values.numel() for values in ours.parameters()) == 950_056_107


@pytest.mark.parametrize("has_reference", [True, False])
def test_the_modules_equal_diffusers(has_reference: bool, weights: Path) -> None:
    image, reference = images(2, 128, 64)
    views = (image, reference) if has_reference else (image,)
    model = difix_weights.load(weights, has_reference, torch.float32)
    ours = model(*views)
    theirs = oracle(weights)(*views)
    assert ours.shape == image.shape
    assert (ours - theirs).abs().max() < TOLERANCE
    # Not because all is clamped, or alike.
    assert (theirs.abs() < 0.99).float().mean() > 0.5 and theirs.std() > 0.1


def test_two_layers_half_of_the_skips_and_an_upcast_attention_equal_diffusers(tmp_path: Path) -> None:
    changes = {"vae": {"layers_per_block": 2, "gamma": 0.5}, "unet": {"layers_per_block": 2, "upcast_attention": True}}
    folder = difix_doubles.write_folder(tmp_path / "weights", changes=changes)
    image, reference = images(1, 64, 64)
    model = difix_weights.load(folder, True, torch.float32)
    assert (model(image, reference) - oracle(folder)(image, reference)).abs().max() < TOLERANCE


def test_the_step_equals_that_of_diffusers() -> None:
    scheduler = diffusers.DDPMScheduler.from_config(difix_doubles.SCHEDULER)
    scheduler.set_timesteps(timesteps=[199])
    generator = torch.Generator().manual_seed(1)
    latent, noise = torch.randn(2, 4, 8, 8, generator=generator), torch.randn(2, 4, 8, 8, generator=generator)
    theirs = scheduler.step(noise, scheduler.timesteps[0], latent).prev_sample
    step = Step.read(difix_doubles.SCHEDULER)
    assert ((latent - step.noise_weight * noise) / step.signal_weight - theirs).abs().max() < 1e-5


# --- The graph


@pytest.mark.parametrize(("batch", "height", "width"), [(1, 64, 64), (2, 128, 64), (3, 64, 192)])
def test_the_graph_equals_the_modules_at_every_size(
    batch: int, height: int, width: int, weights: Path, exported: Path
) -> None:
    image, reference = images(batch, height, width)
    graph = session(exported)
    feed = {"image": image.numpy(), "reference": reference.numpy()}
    (repaired,) = graph.run(None, feed)
    modules = difix_weights.load(weights, True, torch.float32)(image, reference).numpy()
    assert repaired.shape == image.shape
    assert np.abs(repaired - modules).max() < TOLERANCE
    # A batch gives the bits of its images one by one.
    for at in range(batch):
        (one,) = graph.run(None, {name: values[at : at + 1] for name, values in feed.items()})
        assert (one[0] == repaired[at]).all()


def test_the_graph_without_reference(weights: Path, alone: Path) -> None:
    image, _ = images(2, 64, 128)
    graph = session(alone)
    assert [port.name for port in graph.get_inputs()] == ["image"]
    (repaired,) = graph.run(None, {"image": image.numpy()})
    assert np.abs(repaired - oracle(weights)(image).numpy()).max() < TOLERANCE
    assert [(graph.run(None, {"image": image.numpy()[at : at + 1]})[0] == repaired[at]).all() for at in (0, 1)] == [
        True,
        True,
    ]
    assert [entry["role"] for entry in json.loads(alone.read_text())["inputs"]] == ["rgb"]


def test_the_reference_counts_and_other_images_of_the_batch_do_not(exported: Path) -> None:
    image, reference = (values.numpy() for values in images(2, 64, 64))
    graph = session(exported)

    def turned(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Other colours in the last corner of the first image."""
        changed = values.copy()
        changed[0, :, 48:, 48:] *= -1
        return changed

    before = graph.run(None, {"image": image, "reference": reference})[0]
    with_reference = graph.run(None, {"image": image, "reference": turned(reference)})[0]
    with_image = graph.run(None, {"image": turned(image), "reference": reference})[0]
    # Far from what changed: attention carries it there.
    assert np.abs(with_reference[0, :, :16, :16] - before[0, :, :16, :16]).max() > TOLERANCE
    assert (with_reference[1] == before[1]).all() and (with_image[1] == before[1]).all()
    # Where it changed: the image is repaired, not its reference.
    corner = np.s_[0, :, 48:, 48:]
    by_image = np.abs(with_image[corner] - before[corner]).mean()
    by_reference = np.abs(with_reference[corner] - before[corner]).mean()
    assert by_image > 10 * by_reference


def test_the_program_checks_the_exported_graph(exported: Path) -> None:
    done = check(at_8192_pixels(exported), "--size", "70x100")
    assert done.returncode == 0, done.stderr
    assert "three runs gave the same bytes" in done.stdout


def test_the_graph_is_plain_onnx_of_opset_17(exported: Path) -> None:
    import onnx

    graph = onnx.load(exported.with_suffix(".onnx"))
    assert [(one.domain, one.version) for one in graph.opset_import] == [("", 17)]
    assert not {node.op_type for node in graph.graph.node} & {"RandomNormal", "RandomNormalLike", "Dropout"}
    ports = {port.name: port.type.tensor_type for port in [*graph.graph.input, *graph.graph.output]}
    assert list(ports) == ["image", "reference", "repaired"]
    for port in ports.values():
        assert [dim.dim_param or dim.dim_value for dim in port.shape.dim] == ["batch", 3, "height", "width"]


def test_weights_beside_the_graph_give_the_same_bits(weights: Path, exported: Path, tmp_path: Path) -> None:
    beside = export_difix.export(weights, tmp_path / "difix_ref.onnx", dtype="f32", providers=["cpu"], external_above=0)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "difix_ref.json",
        "difix_ref.onnx",
        "difix_ref.onnx.data",
    ]
    files = json.loads(beside.read_text())["files"]
    assert [file["path"] for file in files] == ["difix_ref.onnx", "difix_ref.onnx.data"]
    assert (tmp_path / "difix_ref.onnx").stat().st_size < exported.with_suffix(".onnx").stat().st_size / 2
    image, reference = images(1, 64, 64)
    feed = {"image": image.numpy(), "reference": reference.numpy()}
    assert (session(beside).run(None, feed)[0] == session(exported).run(None, feed)[0]).all()
    done = check(at_8192_pixels(beside), "--size", "64x64")
    assert done.returncode == 0, done.stderr


def test_fused_attention_computes_the_same(weights: Path, exported: Path, tmp_path: Path) -> None:
    import onnx

    fused = export_difix.export(weights, tmp_path / "difix_ref.onnx", dtype="f32", providers=["cpu"], attention="fused")
    nodes = [node.op_type for node in onnx.load(tmp_path / "difix_ref.onnx").graph.node]
    # Three levels with one attention down and two up, and one in the middle.
    assert nodes.count("MultiHeadAttention") == 10
    image, reference = images(2, 64, 128)
    feed = {"image": image.numpy(), "reference": reference.numpy()}
    assert np.abs(session(fused).run(None, feed)[0] - session(exported).run(None, feed)[0]).max() < TOLERANCE
    done = check(at_8192_pixels(fused), "--size", "64x64")
    assert done.returncode == 0, done.stderr


def test_the_same_weights_give_the_same_file(weights: Path, alone: Path, tmp_path: Path) -> None:
    again = export_difix.export(weights, tmp_path / "difix.onnx", dtype="f32", reference=False)
    assert again.read_bytes() == alone.read_bytes()


def test_f16(weights: Path, tmp_path: Path) -> None:
    half = export_difix.export(weights, tmp_path / "difix_ref.onnx", providers=["cpu"])
    assert {entry["dtype"] for entry in json.loads(half.read_text())["inputs"]} == {"f16"}
    graph = session(half)
    assert {port.type for port in [*graph.get_inputs(), *graph.get_outputs()]} == {"tensor(float16)"}
    image, reference = images(2, 64, 128)
    feed = {"image": image.numpy().astype(np.float16), "reference": reference.numpy().astype(np.float16)}
    (repaired,) = graph.run(None, feed)
    exact = difix_weights.load(weights, True, torch.float32)(image, reference).numpy()
    assert np.abs(repaired - exact).max() < 0.02
    done = check(at_8192_pixels(half), "--size", "70x100")
    assert done.returncode == 0, done.stderr


def test_the_command_compares_the_graph_with_the_modules(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "difix.onnx"
    command = ["--weights", str(weights), "--out", str(out), "--no-reference", "--dtype", "f32", "--compare"]
    monkeypatch.setitem(export_difix.LARGEST_DIFFERENCE, "f32", 1e-9)
    assert export_difix.main(command) == 1
    assert "error: --compare: " in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    assert export_difix.main(command) == 0
    printed = capsys.readouterr()
    assert printed.out == f"{tmp_path / 'difix.json'}\n"
    assert float(printed.err.split("PyTorch: ")[1].split()[0]) < TOLERANCE


def test_upcast_scores_do_not_leave_the_range_of_f16() -> None:
    tokens = torch.ones(1, 3, 8).half()
    for upcast in (True, False):
        attention = Attention(8, 1, 8, upcast=upcast).half()
        for layer in (attention.to_q, attention.to_k):
            torch.nn.init.constant_(layer.weight, 40.0)
        # 8 products of 320 and 320, divided by the root of 8: 290,000.
        assert attention(tokens, tokens).isfinite().all() == upcast


# --- What is refused


@pytest.mark.parametrize(("height", "width"), [(72, 136), (96, 64), (64, 96), (0, 64)])
def test_sides_must_be_multiples_of_64(height: int, width: int, weights: Path, exported: Path) -> None:
    model = difix_weights.load(weights, True, torch.float32)
    image = torch.zeros(1, 3, height, width)
    with pytest.raises(ExportError, match="multiples of 64|the shape") as refused:
        model(image, image)
    assert refused.value.field == "image"
    with pytest.raises(Exception, match="(?i)concat|shape|dimension|invalid"):
        session(exported).run(None, {"image": image.numpy(), "reference": image.numpy()})


def test_image_and_reference_must_fit(weights: Path) -> None:
    image = torch.zeros(1, 3, 64, 64)
    model = difix_weights.load(weights, True, torch.float32)
    for reference, says in ((None, "needed"), (torch.zeros(1, 3, 64, 128), "that of the image")):
        with pytest.raises(ExportError, match=says) as refused:
            model(image, reference)
        assert refused.value.field == "reference"
    with pytest.raises(ExportError, match="this model has none"):
        difix_weights.load(weights, False, torch.float32)(image, image)


DAMAGES = [
    ("unet", "mid_block.resnets.1.conv2.bias", None, "missing; Difix has it"),
    ("vae", "decoder.skip_conv_3.base_layer.weight", None, "an adapter needs"),
    ("vae", "decoder.skip_conv_2.lora_B.vae_skip.weight", None, "an adapter needs"),
    ("vae", "encoder.conv_in.weight", lambda t: t[:, :2], "the shape [8, 2, 3, 3]; Difix has [8, 3, 3, 3]"),
    ("vae", "decoder.conv_in.lora_A.vae_skip.weight", lambda t: t[:3], "do not fit"),
    ("unet", "extra.weight", lambda t: torch.zeros(1), "Difix has no such tensor"),
    ("unet", "conv_in.bias", lambda t: t * torch.nan, "NaN"),
    ("unet", "conv_out.weight", lambda t: t * 1e7, "--dtype f32"),
]


@pytest.mark.parametrize(("part", "tensor", "change", "says"), DAMAGES)
def test_damaged_weights_are_refused_with_the_tensor(
    part: str, tensor: str, change: Callable[[Any], torch.Tensor] | None, says: str, weights: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(weights, tmp_path / "weights")
    file = folder / part / "diffusion_pytorch_model.safetensors"
    tensors = load_file(file)
    if change is None:
        del tensors[tensor]
    else:
        tensors[tensor] = change(tensors.get(tensor)).contiguous()
    save_file(tensors, file)
    out = tmp_path / "out"
    out.mkdir()
    (out / "difix_ref.onnx").write_bytes(b"as it was")
    with pytest.raises(ExportError) as refused:
        export_difix.export(folder, out / "difix_ref.onnx")
    layer = tensor.split(".lora_", maxsplit=1)[0].split(".base_layer", maxsplit=1)[0]
    assert refused.value.field.startswith(f"{part}/diffusion_pytorch_model.safetensors: {layer}"), refused.value.field
    assert says in refused.value.message, refused.value.message
    assert [path.name for path in out.iterdir()] == ["difix_ref.onnx"]
    assert (out / "difix_ref.onnx").read_bytes() == b"as it was"


def test_an_incomplete_folder_is_refused(weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missing = {
        "vae/config.json": "vae/config.json",
        "unet/diffusion_pytorch_model.safetensors": "unet/diffusion_pytorch_model.safetensors",
        "scheduler/scheduler_config.json": "scheduler/scheduler_config.json",
        "text_encoder/model.safetensors": "text_encoder",
        "tokenizer": "tokenizer",
    }
    for at, (path, says) in enumerate(missing.items()):
        folder = shutil.copytree(weights, tmp_path / f"weights{at}")
        shutil.rmtree(folder / path) if (folder / path).is_dir() else (folder / path).unlink()
        assert export_difix.main(["--weights", str(folder), "--out", str(tmp_path / "difix.onnx")]) == 1
        assert f"error: {says}" in capsys.readouterr().err
    for wrong in (tmp_path / "absent", weights / "vae" / "config.json"):
        assert export_difix.main(["--weights", str(wrong), "--out", str(tmp_path / "difix.onnx")]) == 1
        assert "error: --weights: " in capsys.readouterr().err
    assert not list(tmp_path.glob("*difix*"))


def test_a_repository_is_downloaded_only_if_no_folder_has_its_name(
    weights: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import huggingface_hub

    asked: list[str] = []

    def download(repository: str, allow_patterns: list[str]) -> str:
        asked.append(repository)
        if repository != "nvidia/difix_ref":
            raise OSError("no such repository")
        assert "unet/*.safetensors" in allow_patterns
        return str(weights)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    monkeypatch.chdir(tmp_path)
    assert difix_weights.folder("nvidia/difix_ref") == weights
    assert "downloading nvidia/difix_ref from huggingface.co" in capsys.readouterr().err
    with pytest.raises(ExportError, match="no such repository"):
        difix_weights.folder("nvidia/difux")
    for path in ("difix_ref", "./nvidia/difix_ref", "/nvidia/difix_ref", "../difix_ref", "a/b/c"):
        with pytest.raises(ExportError, match="no such folder"):
            difix_weights.folder(path)
    assert asked == ["nvidia/difix_ref", "nvidia/difux"]
    (tmp_path / "nvidia" / "difix_ref").mkdir(parents=True)
    assert difix_weights.folder("nvidia/difix_ref") == Path("nvidia/difix_ref")
    assert len(asked) == 2


def test_adapters_are_added_as_peft_adds_them() -> None:
    torch.manual_seed(5)
    layers = torch.nn.ModuleDict({"conv": torch.nn.Conv2d(3, 6, 3), "linear": torch.nn.Linear(5, 7)})
    for alpha in (8, 3):
        config = peft.LoraConfig(r=2, lora_alpha=alpha, target_modules=["conv", "linear"], init_lora_weights=False)
        adapted = peft.inject_adapter_in_model(config, torch.nn.ModuleDict({**layers}), adapter_name="vae_skip")
        stored = {name: values.clone() for name, values in adapted.state_dict().items()}
        merged = difix_weights.merge_adapters(stored, "vae", alpha)
        assert set(merged) == set(layers.state_dict())
        image, row = torch.randn(1, 3, 5, 5), torch.randn(1, 5)
        conv = torch.nn.functional.conv2d(image, merged["conv.weight"], merged["conv.bias"])
        assert (conv - adapted["conv"](image)).abs().max() < 1e-5
        linear = torch.nn.functional.linear(row, merged["linear.weight"], merged["linear.bias"])
        assert (linear - adapted["linear"](row)).abs().max() < 1e-5
    assert peft.LoraConfig().lora_alpha == difix_weights.LORA_ALPHA


def test_the_prompt_is_padded_to_77_tokens_and_counts(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    embedding = difix_weights.prompt_embedding(weights)
    assert embedding.shape == (1, 77, 12)
    image, reference = images(1, 64, 64)
    model = difix_weights.load(weights, True, torch.float32)
    before = model(image, reference)
    assert (model.prompt == embedding).all()
    monkeypatch.setattr(difix_weights, "PROMPT", "add degradation")
    after = difix_weights.load(weights, True, torch.float32)(image, reference)
    assert (after - before).abs().max() > 1e-5
