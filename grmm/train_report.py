"""What a training run says of itself at its end: metrics.json and preview pictures."""

from __future__ import annotations

from pathlib import Path

from express50.files.atomic import write_json
from grmm.config import Config
from grmm.evaluate import evaluate, mean, training_render
from grmm.judge import Judge
from grmm.order import spread
from grmm.render import comparison_sheet
from grmm.run import Run


def report(run: Run, config: Config, out: Path) -> dict[str, object]:
    """Evaluate, draw previews and write metrics.json."""
    render = training_render(run.result, run.views)
    count = config.train.evaluate_images
    trained = {(run.views.keys[i].subject, run.views.keys[i].expression) for i in run.training}
    frame_of = {i: (run.views.keys[i].subject, run.views.keys[i].expression) for i in run.holdout}
    judge = Judge(config.metrics)
    training = evaluate(run.views, spread(run.training, count), render)
    held = [i for i in run.holdout if frame_of[i] in trained]
    new = [i for i in run.holdout if frame_of[i] not in trained]
    holdout = evaluate(run.views, spread(held, count), render, judge)
    expressions = evaluate(run.views, spread(new, count), render)
    metrics: dict[str, object] = {
        "psnr_train_db": mean(training, "psnr_db"),
        "psnr_heldout_view_db": mean(holdout, "psnr_db"),
        "psnr_heldout_view_head_db": mean(holdout, "psnr_head_db"),
        "psnr_heldout_view_unrefined_db": mean(holdout, "psnr_unrefined_db"),
        "psnr_heldout_expression_db": mean(expressions, "psnr_db"),
        "ssim": mean(holdout, "ssim") if holdout else mean(training, "ssim"),
        "rmse": mean(holdout or training, "rmse"),
        "lpips": mean(holdout, "lpips"),
        "fid": judge.fid(),
        "psnr_heldout_view_with_torso_db": mean(holdout, "psnr_with_torso_db"),
        "psnr_counts": f"all pixels that the camera saw; torso: {config.data.torso}",
        "depth_median_mm": mean(holdout or training, "depth_mm"),
        "heldout_images": len(holdout),
        "heldout_expression_images": len(expressions),
        "heldout_cameras": list(config.data.holdout_cameras),
        "training_views": len(run.training),
        "subjects": list(run.model.subjects),
        "expressions": list(run.model.expressions),
        "gaussians": len(run.model.texels),
        "texels": config.model.n_g**2,
        "parameters": sum(parameter.numel() for parameter in run.model.parameters()),
        "iterations": run.iteration,
        "seconds": round(run.seconds, 2),
        "iterations_per_second": round(run.iteration / max(run.seconds, 1e-9), 3),
        "terms": {name: round(value, 6) for name, value in run.terms.items()},
        "perceptual": "on" if run.perceptual else "off: loss.vgg16 names no weights",
    }
    metrics |= judge.missing()
    for name, indices in (("training", run.training), ("heldout", run.holdout)):
        if indices:
            path = out / "preview" / f"{name}.jpg"
            comparison_sheet(path, run.views, spread(indices, 6), render)
    write_json(out / "metrics.json", metrics)
    return metrics
