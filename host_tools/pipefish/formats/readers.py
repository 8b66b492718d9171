"""Readers of the mappings (YAML, JSON) that other programs write. docs/formats.md says what each number means and
where that is written.

A reader takes the document and the image size that the user gave (or None) and returns the cameras of the file.
"""

from __future__ import annotations

import re
from typing import Any

from ..errors import ProfileError
from ..lenses import (
    DoubleSphere,
    ExtendedUnified,
    FieldOfView,
    Generic,
    KannalaBrandt,
    OCam,
    Perspective,
    RadialPolynomial,
    Unified,
)
from .parse import Found, Node, number_list, shown, whole

Size = tuple[int, int]


def need_size(size: Size | None, what: str = "image size") -> Size:
    """The size, or ProfileError that asks for it."""
    if size is None:
        raise ProfileError(None, what, "not in the file: give it (--camera-size WxH; in Python size=(w, h))")
    return size


def image(size: Size) -> dict[str, int]:
    """The size as arguments of a Lens."""
    return {"width": size[0], "height": size[1]}


def pinhole(node: Node, prefix: str = "") -> dict[str, float]:
    """fx, fy, cx, cy of a mapping."""
    return {key: node.number(prefix + key) for key in ("fx", "fy", "cx", "cy")}


def opencv_distortion(k: tuple[float, ...], where: str) -> dict[str, Any]:
    """OpenCV's order: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tilt_x tilt_y]]]]."""
    k = (*k, *(0.0,) * (14 - len(k)))
    if any(k[12:]):
        raise ProfileError(None, where, "the tilted sensor of OpenCV's 14 coefficients is not read")
    return {"radial": (k[0], k[1], k[4]), "denominator": k[5:8], "tangential": k[2:4], "prism": k[8:12]}


def _matrix(node: Node, key: str) -> dict[str, float]:
    m = node.numbers(key, 9)
    if any((m[3], m[6], m[7])) or m[8] != 1:
        raise ProfileError(None, node.place(key), "not a camera matrix: its last row is not 0 0 1")
    return {"fx": m[0], "skew": m[1], "cx": m[2], "fy": m[4], "cy": m[5]}


def _first(node: Node, *keys: str) -> str:
    for key in keys:
        if key in node:
            return key
    raise ProfileError(None, node.place(keys[0]), "missing")


# ---- OpenCV and ROS


_MATRICES = ("camera_matrix", "K", "k", "cameraMatrix", "intrinsic_matrix")
_COEFFICIENTS = ("distortion_coefficients", "D", "d", "distCoeffs", "distortion_coeffs", "dist_coeffs")


def _opencv_parts(node: Node, size: Size | None) -> tuple[dict[str, Any], str]:
    core: dict[str, Any] = dict(_matrix(node, _first(node, *_MATRICES)))
    for width, height in (("image_width", "image_height"), ("width", "height"), ("image_Width", "image_Height")):
        if width in node:
            size = node.size(width, height)
            break
    else:
        for key in ("image_size", "imageSize", "resolution"):
            if key in node:
                size = (whole(v, node.place(key)) for v in node.numbers(key, 2))  # type: ignore[assignment]
                break
    return core | image(tuple(need_size(size))), _first(node, *_COEFFICIENTS)


def read_opencv_fisheye(document: Any, size: Size | None) -> list[Found]:
    """OpenCV's fisheye module, whatever else the file says."""
    node = Node(document)
    core, d = _opencv_parts(node, size)
    return [Found("camera", KannalaBrandt(k=node.numbers(d, 4), **core))]


def read_opencv(document: Any, size: Size | None) -> list[Found]:
    """OpenCV's calib3d (not fisheye)."""
    node = Node(document)
    core, d = _opencv_parts(node, size)
    k = node.numbers(d, (4, 5, 8, 12, 14))
    return [Found("camera", Perspective(**core, **opencv_distortion(k, node.place(d))))]


def read_opencv_omnidir(document: Any, size: Size | None) -> list[Found]:
    """OpenCV contrib's omnidir: Mei's model with k1 k2 p1 p2."""
    node = Node(document)
    core, d = _opencv_parts(node, size)
    k = node.numbers(d, 4)
    xi = node.numbers("xi", 1)[0] if isinstance(node.get("xi"), list | dict) else node.number("xi")
    return [Found("camera", Unified(xi=xi, radial=k[:2], tangential=k[2:4], **core))]


def read_opencv_any(document: Any, size: Size | None) -> list[Found]:
    """An OpenCV file without a word about its model: told by what it holds, refused where that is open."""
    node = Node(document)
    if "xi" in node:
        return read_opencv_omnidir(document, size)
    kind = str(node.value.get("distortion_model", node.value.get("model", ""))).lower()
    if node.value.get("fisheye_model") == 1 or kind in ("fisheye", "equidistant", "kannala_brandt"):
        return read_opencv_fisheye(document, size)
    d = _first(node, *_COEFFICIENTS)
    if len(node.numbers(d)) == 4 and "fisheye_model" not in node:
        raise ProfileError(
            None,
            node.place(d),
            "four coefficients are a fisheye's or a pinhole's, and the file does not say whose: "
            "give --from opencv-fisheye or --from opencv",
        )
    return read_opencv(document, size)


#: CameraInfo's distortion_model and how many coefficients it has.
ROS_MODELS = {"equidistant": (4,), "fisheye": (4,), "plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14)}


def _ros_whole(node: Node, core: dict[str, Any]) -> None:
    """Refuses binned and cropped pictures: K is of the whole sensor at its full resolution, and the message does not
    say where a binned pixel's centre lies."""
    for key in ("binning_x", "binning_y"):
        if node.number(key, 0.0) not in (0, 1):
            raise ProfileError(None, node.place(key), "binned pictures are not read: the numbers are of the full size")
    if "roi" not in node:
        return
    roi = node.child("roi")
    x, y, width, height = (roi.number(key, 0.0) for key in ("x_offset", "y_offset", "width", "height"))
    if (x, y) != (0, 0) or (width, height) not in ((0, 0), (core["width"], core["height"])):
        raise ProfileError(None, node.place("roi"), "cropped pictures are not read: the numbers are of the whole one")


def read_ros(document: Any, size: Size | None) -> list[Found]:
    """sensor_msgs/CameraInfo as YAML. K is used; R and P belong to rectified images."""
    node = Node(document)
    kind = node.text("distortion_model")
    core, d = _opencv_parts(node, size)
    name = node.text("camera_name", "camera")
    where = node.place(d)
    _ros_whole(node, core)
    if kind not in ROS_MODELS:
        raise ProfileError(None, node.place("distortion_model"), f"{shown(kind)} is not read: {', '.join(ROS_MODELS)}")
    k = node.numbers(d, ROS_MODELS[kind])
    if kind in ("equidistant", "fisheye"):
        return [Found(name, KannalaBrandt(k=k, **core))]
    return [Found(name, Perspective(**core, **opencv_distortion(k, where)))]


# ---- Kalibr and basalt


def _kalibr_camera(node: Node) -> Any:
    size = tuple(whole(v, node.place("resolution")) for v in node.numbers("resolution", 2))
    model, distortion = node.text("camera_model"), node.text("distortion_model", "none")
    d = node.numbers("distortion_coeffs") if "distortion_coeffs" in node else ()
    count = {"pinhole": 4, "omni": 5, "ds": 6, "eucm": 6}.get(model)
    if count is None:
        raise ProfileError(None, node.place("camera_model"), f"{shown(model)} is not read: pinhole, omni, ds, eucm")
    *extra, fx, fy, cx, cy = node.numbers("intrinsics", count)
    core = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **image(size)}  # type: ignore[arg-type]
    lengths = {"none": (0, 4), "radtan": (4,), "equidistant": (4,), "fov": (1,)}
    if len(d) not in lengths.get(distortion, ()):
        raise ProfileError(None, node.place("distortion_coeffs"), f"{len(d)} numbers do not make {shown(distortion)}")
    radtan = {"radial": d[:2], "tangential": d[2:4]} if distortion == "radtan" else {}
    if distortion == "none" and any(d):
        raise ProfileError(None, node.place("distortion_coeffs"), "not zero, but distortion_model is none")
    if model == "pinhole":
        if distortion == "equidistant":
            return KannalaBrandt(k=d, **core)
        return FieldOfView(omega=d[0], **core) if distortion == "fov" else Perspective(**core, **radtan)
    if model == "omni" and distortion in ("radtan", "none"):
        return Unified(xi=extra[0], **core, **radtan)
    if distortion != "none":
        raise ProfileError(None, node.place("distortion_model"), f"{model} with {distortion} is not read")
    if model == "ds":
        return DoubleSphere(xi=extra[0], alpha=extra[1], **core)
    return ExtendedUnified(alpha=extra[0], beta=extra[1], **core)


def read_kalibr(document: Any, size: Size | None) -> list[Found]:
    """A camchain, with or without the IMU."""
    node = Node(document)
    names = sorted((k for k in node.value if re.fullmatch(r"cam\d+", str(k))), key=lambda k: int(k[3:]))
    if not names:
        raise ProfileError(None, "cam0", "missing: this is not a camchain")
    return [Found(name, _kalibr_camera(node.child(name))) for name in names]


def _basalt_camera(kind: str, node: Node, size: Size) -> Any:
    core: dict[str, Any] = {**pinhole(node), **image(size)}
    if kind == "kb4":
        return KannalaBrandt(k=tuple(node.number(f"k{i}") for i in range(1, 5)), **core)
    if kind == "ds":
        return DoubleSphere(xi=node.number("xi"), alpha=node.number("alpha"), **core)
    if kind in ("eucm", "ucm"):
        alpha = node.number("alpha")
        return ExtendedUnified(alpha=alpha, beta=node.number("beta") if kind == "eucm" else 1.0, **core)
    if kind == "fov":
        return FieldOfView(omega=node.number("w"), **core)
    if kind in ("pinhole", "pinhole-radtan8"):
        eight = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        k = tuple(node.number(key) for key in eight) if kind != "pinhole" else (0.0,) * 4
        return Perspective(**core, **opencv_distortion(k, node.place("k1")))
    raise ProfileError(None, node.place("camera_type"), f"{shown(kind)} is not read")


def read_basalt(document: Any, size: Size | None) -> list[Found]:
    """basalt's calibration.json."""
    top = Node(document).child("value0")
    cameras, sizes = top.get("intrinsics"), top.get("resolution")
    if not isinstance(cameras, list) or not isinstance(sizes, list) or len(cameras) != len(sizes):
        raise ProfileError(None, top.place("intrinsics"), "not as many cameras as resolutions")
    found = []
    for i, (camera, pair) in enumerate(zip(cameras, sizes, strict=True)):
        node = Node(camera, top.place(f"intrinsics[{i}]"))
        where = top.place(f"resolution[{i}]")
        w, h = number_list(pair, where, 2)
        shape = (whole(w, where), whole(h, where))
        found.append(Found(f"cam{i}", _basalt_camera(node.text("camera_type"), node.child("intrinsics"), shape)))
    return found


# ---- SLAM systems


def read_orbslam3(document: Any, size: Size | None) -> list[Found]:
    """ORB-SLAM3 settings, of file version 1.0 (Camera1.fx) or older (Camera.fx)."""
    node = Node(document)
    kind = node.text("Camera.type", "PinHole")
    if "Camera.width" in node:
        size = node.size("Camera.width", "Camera.height")
    found = []
    for name in ("Camera", "Camera1", "Camera2"):
        if f"{name}.fx" not in node:
            continue
        core: dict[str, Any] = {**pinhole(node, f"{name}."), **image(need_size(size, "Camera.width"))}
        if kind == "KannalaBrandt8":
            lens: Any = KannalaBrandt(k=tuple(node.number(f"{name}.k{i}") for i in range(1, 5)), **core)
        elif kind in ("PinHole", "Rectified"):
            k = tuple(node.number(f"{name}.{key}", 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
            lens = Perspective(**core, **opencv_distortion(k, name))
        else:
            raise ProfileError(None, "Camera.type", f"{shown(kind)} is not read: KannalaBrandt8, PinHole")
        found.append(Found(name, lens))
    notes = ["newWidth: the system scales its images; the profile is for the camera's own size"]
    if found and "Camera.newWidth" in node:
        found[0].notes += notes
    if not found:
        raise ProfileError(None, "Camera1.fx", "missing")
    return found


def read_stella(document: Any, size: Size | None) -> list[Found]:
    """stella_vslam and OpenVSLAM configuration."""
    node = Node(document).child("Camera")
    model = node.text("model")
    if model == "equirectangular":
        raise ProfileError(
            None, node.place("model"), "an equirectangular image is no camera: it has no lens to convert"
        )
    core: dict[str, Any] = {**pinhole(node), **image(node.size("cols", "rows"))}
    name = node.text("name", "camera")
    if model == "fisheye":
        return [Found(name, KannalaBrandt(k=tuple(node.number(f"k{i}") for i in range(1, 5)), **core))]
    if model == "perspective":
        k = tuple(node.number(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
        return [Found(name, Perspective(**core, **opencv_distortion(k, node.place("k1"))))]
    if model == "radial_division":
        raise ProfileError(None, node.place("model"), "the division model is not read")
    raise ProfileError(None, node.place("model"), f"{shown(model)} is not read: fisheye, perspective")


def scaramuzza(size: Size, polynomial: tuple[float, ...], centre: tuple[float, float], stretch: Any) -> OCam:
    """The toolbox's cameras look along -z with p0 < 0; others write +z. Either way the axis looks into the scene."""
    if not polynomial or polynomial[0] == 0:
        raise ProfileError(None, "polynomial", "its first coefficient, the scale on the axis, is zero")
    sign = 1.0 if polynomial[0] > 0 else -1.0
    return OCam(
        **image(size), polynomial=tuple(sign * p for p in polynomial), cx=centre[0], cy=centre[1], stretch=stretch
    )


def read_svo(document: Any, size: Size | None) -> list[Found]:
    """SVO's camera rigs: pinhole (radial-tangential, equidistant) and omni (Scaramuzza's)."""
    cameras = Node(document).get("cameras")
    found = []
    for i, entry in enumerate(cameras if isinstance(cameras, list) else []):
        node = Node(entry, f"cameras[{i}]").child("camera")
        kind, distortion = node.text("type"), node.child("distortion").text("type")
        shape = node.size("image_width", "image_height")
        v = node.numbers("intrinsics", 24 if kind == "omni" else 4)
        where = node.place("distortion")
        if kind == "omni":
            c, d, e = v[7:10]
            if v[22:] != (0.0, 1.0):
                raise ProfileError(None, node.place("intrinsics"), "an image mask radius is not read")
            lens: Any = scaramuzza(shape, v[:5], (v[5], v[6]), ((1.0, e), (d, c)))
        elif kind == "pinhole":
            core = {"fx": v[0], "fy": v[1], "cx": v[2], "cy": v[3], **image(shape)}
            k = node.child("distortion").numbers("parameters") if distortion != "none" else (0.0,) * 4
            if distortion == "equidistant" and len(k) == 4:
                lens = KannalaBrandt(k=k, **core)  # type: ignore[arg-type]
            elif distortion in ("radial-tangential", "none") and len(k) in (4, 5):
                lens = Perspective(**core, **opencv_distortion(k, where))  # type: ignore[arg-type]
            else:
                raise ProfileError(None, where, f"{shown(distortion)} with {len(k)} numbers is not read")
        else:
            raise ProfileError(None, node.place("type"), f"{shown(kind)} is not read: pinhole, omni")
        found.append(Found(node.text("label", f"cam{i}"), lens))
    if not found:
        raise ProfileError(None, "cameras", "no camera")
    return found


def read_adapter(document: Any, size: Size | None) -> list[Found]:
    """fisheye-calib-adapter: one model a file, told by its parameters."""
    top = Node(document)
    shape, node = top.child("image").size(), top.child("parameter")
    if "coefficients" in node:
        c, d, e = (node.number(key) for key in "cde")
        polynomial = node.child("coefficients").numbers("unprojection")
        centre = (node.number("cx"), node.number("cy"))
        return [Found("camera", scaramuzza(shape, polynomial, centre, ((c, d), (e, 1.0))))]
    core: dict[str, Any] = {**pinhole(node), **image(shape)}
    if "beta" in node:
        return [Found("camera", ExtendedUnified(alpha=node.number("alpha"), beta=node.number("beta"), **core))]
    if "xi" in node:
        return [Found("camera", DoubleSphere(xi=node.number("xi"), alpha=node.number("alpha"), **core))]
    if "alpha" in node:
        return [Found("camera", ExtendedUnified(alpha=node.number("alpha"), beta=1.0, **core))]
    if "p1" in node:
        k = tuple(node.number(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
        return [Found("camera", Perspective(**core, **opencv_distortion(k, node.place("k1"))))]
    if "k4" in node:
        return [Found("camera", KannalaBrandt(k=tuple(node.number(f"k{i}") for i in range(1, 5)), **core))]
    raise ProfileError(None, "parameter", "these are the parameters of no known model")


# ---- others


def read_boofcv(document: Any, size: Size | None) -> list[Found]:
    """BoofCV's calibration YAML."""
    node = Node(document)
    model = node.text("model")
    inner = node.child("pinhole")
    shape = inner.size()
    core: dict[str, Any] = {**pinhole(inner), "skew": inner.number("skew", 0.0), **image(shape)}
    if model in ("pinhole", "pinhole_radial_tangential", "omnidirectional_universal"):
        bent = node.child("radial_tangential") if "radial_tangential" in node else Node({})
        radial = bent.numbers("radial") if "radial" in bent else ()
        parts = {"radial": radial, "tangential": (bent.number("t1", 0.0), bent.number("t2", 0.0))}
        if model == "omnidirectional_universal":
            return [Found("camera", Unified(xi=node.number("mirror_offset"), **core, **parts))]
        return [Found("camera", Perspective(**core, **parts))]
    if model == "kannala_brandt":
        lists = ("symmetric", "radial", "radial_trig", "tangent", "tangent_trig")
        symmetric, *asymmetric = (node.numbers(key) if node.value.get(key) else () for key in lists)
        polynomial = (*symmetric, *(0.0,) * (5 - len(symmetric)))
        return [Found("camera", generic_lens(core, polynomial, *asymmetric))]
    raise ProfileError(None, "model", f"{shown(model)} is not read")


def generic_lens(core: dict[str, Any], k: tuple[float, ...], *asymmetric: tuple[float, ...]) -> Generic:
    """Kannala and Brandt's own parameters, in our gauge: k1 = 1 and phi vectors of unit norm.

    core: fx, fy, cx, cy, skew, width, height; asymmetric: radial theta (3) and phi (4), tangential theta and phi.
    """
    if len(k) != 5 or not k[0] > 0:
        raise ProfileError(None, "k1", "the radial polynomial does not begin with a positive coefficient")
    fields: dict[str, Any] = {
        "f_u": core["fx"] * k[0],
        "f_v": core["fy"] * k[0],
        "skew": core["skew"] * k[0],
        "c_u": core["cx"],
        "c_v": core["cy"],
        **{name: v / k[0] for name, v in zip(("k2", "k3", "k4", "k5"), k[1:], strict=True)},
    }
    for name, theta, phi in (
        (
            ("asym_radial", *asymmetric[0:2]),
            ("asym_tangential", *asymmetric[2:4]),
        )
        if asymmetric
        else ()
    ):
        norm = sum(v * v for v in phi) ** 0.5
        if any(theta) and norm > 0:
            if len(theta) != 3 or len(phi) != 4:
                raise ProfileError(None, name, f"{len(theta)} and {len(phi)} numbers where 3 and 4 belong")
            fields[f"{name}_theta"] = tuple(v * norm / k[0] for v in theta)
            fields[f"{name}_phi"] = tuple(v / norm for v in phi)
    return Generic(width=core["width"], height=core["height"], fields=fields)


def read_woodscape(document: Any, size: Size | None) -> list[Found]:
    """WoodScape: polynomial of theta in pixels, principal point as an offset from the image's middle."""
    top = Node(document)
    node = top.child("intrinsic")
    if node.text("model") != "radial_poly":
        raise ProfileError(None, node.place("model"), "not 'radial_poly'")
    width, height = node.size()
    aspect = node.number("aspect_ratio", 1.0)
    core = {
        "fx": 1.0,
        "fy": aspect,
        "cx": (width - 1) / 2 + node.number("cx_offset"),
        "cy": (height - 1) / 2 + node.number("cy_offset"),
    }
    order = node.number("poly_order", 4)
    if order not in range(1, 17):
        raise ProfileError(None, node.place("poly_order"), f"{order:g} is not a whole number from 1 to 16")
    k = tuple(node.number(f"k{i}") for i in range(1, int(order) + 1))
    return [Found(top.text("name", "camera"), RadialPolynomial(coefficients=k, **core, **image((width, height))))]


def read_pyocamcalib(document: Any, size: Size | None) -> list[Found]:
    """py-OCamCalib: Scaramuzza's model with x along the columns and z forward."""
    node = Node(document)
    a, b, c, d = node.numbers("stretch_matrix", 4)
    centre = node.numbers("distortion_center", 2)
    lens = scaramuzza(need_size(size), node.numbers("taylor_coefficient"), (centre[0], centre[1]), ((a, b), (c, d)))
    return [Found(node.text("camera_name", "camera"), lens)]
