"""The demo scene: a still life on a table, and the 17x17 grid of cameras that looks at it.

Everything is made here from numpy and Mitsuba shapes; nothing is loaded from a file.

Notation: world axes x right, y up, z towards the viewer; the table is y = 0; lengths are in scene units
(the table shows about 6 of them). A camera is named by `row` (0 at the top) and `col` (0 at the left) and
sits on a plane at `(x, y) = ((col - 8) STEP, (8 - row) STEP)`, measured along the image's right and up axes
from `EYE`. All cameras look the same way; each image plane is sheared so that the plane at depth `FOCUS`
has zero disparity. Colours are sRGB in [0, 1].
"""

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")
T = mi.ScalarTransform4f

GRID = 17  # cameras on a side
STEP = 0.065  # distance between neighbouring cameras
FOCUS = 10.5  # depth of the plane that stays still in all views
FOV = 30.0  # degrees, across the width
EYE, TARGET = np.array([0.0, 3.6, 11.0]), np.array([0.0, 1.35, 0.0])


# Cameras


def axes():
    """Right, up and forward unit vectors `[3, 3]` shared by all cameras."""
    forward = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward])


def position(row, col):
    """Camera position `(x, y)` on the camera plane, in scene units."""
    return (col - GRID // 2) * STEP, (GRID // 2 - row) * STEP


def disparity(depth, steps=4, size=256):
    """Shift in pixels of a point at `depth` (along the viewing direction) between cameras `steps` apart."""
    return size / 2 / np.tan(np.radians(FOV / 2)) * steps * STEP * (1 / depth - 1 / FOCUS)


def sensor(row, col, size, spp):
    """Mitsuba description of one camera: parallel to the others, image plane sheared."""
    (x, y), (right, up, forward) = position(row, col), axes()
    origin = EYE + x * right + y * up
    width = 2 * FOCUS * np.tan(np.radians(FOV / 2))  # of the still plane, as the camera sees it
    return {
        "type": "perspective",
        "fov": FOV,
        "to_world": T().look_at(origin=origin.tolist(), target=(origin + forward).tolist(), up=up.tolist()),
        "principal_point_offset_x": -x / width,
        "principal_point_offset_y": y / width,
        "film": {
            "type": "hdrfilm",
            "width": size,
            "height": size,
            "pixel_format": "rgb",
            "rfilter": {"type": "gaussian"},
        },
        "sampler": {"type": "multijitter", "sample_count": spp},
    }


# Textures: arrays [h, w, 3]


def noise(h, w, seed, beta=1.6, stretch=1.0):
    """Periodic 1/f^beta noise `[h, w]` in [0, 1]; `stretch` < 1 draws it out along y."""
    fy, fx = np.fft.fftfreq(h)[:, None] * h, np.fft.rfftfreq(w)[None] * w * stretch
    amplitude = np.maximum(np.hypot(fy, fx), 1) ** -beta
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, amplitude.shape)
    out = np.fft.irfft2(amplitude * np.exp(1j * phase), (h, w))
    low, high = np.percentile(out, [1, 99])
    return np.clip((out - low) / (high - low), 0, 1)


def mix(a, b, t):
    """Colour `a` where `t` is 0, `b` where it is 1; `t` is `[h, w]`, colours broadcast."""
    return np.asarray(a) * (1 - t[..., None]) + np.asarray(b) * t[..., None]


def tiles(h, w, ny, nx, drop=0.0):
    """Coordinates inside `ny` x `nx` repeated tiles, each in [-1, 1]; odd columns are lowered by `drop`."""
    v, u = np.meshgrid((np.arange(h) + 0.5) / h * ny, (np.arange(w) + 0.5) / w * nx, indexing="ij")
    v = v + drop * (np.floor(u) % 2)
    return 2 * (u % 1) - 1, 2 * (v % 1) - 1


def edge(x, soft=0.05):
    """1 where x > 0, 0 where x < 0, with a soft step."""
    return np.clip(x / soft + 0.5, 0, 1)


def flower(u, v, petals=5, radius=0.7):
    """Mask of a flower in tile coordinates."""
    r, angle = np.hypot(u, v), np.arctan2(v, u)
    return edge(radius * (0.65 + 0.35 * np.cos(petals * angle)) - r) * edge(r - 0.2 * radius)


def wood(seed, light=(0.72, 0.5, 0.31), dark=(0.38, 0.22, 0.12), planks=9, n=1024):
    """Planks along y, each with its own grain."""
    grain, fine = noise(n, n, seed, 1.5, 1 / 16), noise(n, n, seed + 1, 1.1, 1 / 30)
    which = np.arange(n) * planks // n
    shift = np.random.default_rng(seed).integers(0, n, planks)[which]
    shade = np.random.default_rng(seed + 2).uniform(-0.12, 0.12, planks)[which]
    rows = (np.arange(n)[:, None] + shift) % n
    ring = 0.5 + 0.5 * np.sin(26 * grain[rows, np.arange(n)])
    gap = np.abs((np.arange(n) * planks / n) % 1 - 0.5) > 0.487
    tone = np.clip(0.1 + 0.45 * ring + 0.3 * fine + shade, 0, 1)
    return mix(light, dark, tone) * (1 - 0.7 * gap)[None, :, None]


def wallpaper(n=1024):
    """Half-drop floral paper with fine stripes."""
    u, v = tiles(n, n, 12, 16, 0.5)
    stripe = 0.5 + 0.5 * np.sin(np.arange(n) / n * 2 * np.pi * 48) + np.zeros((n, 1))
    paper = mix((0.30, 0.43, 0.42), (0.33, 0.46, 0.445), stripe)
    paper = mix(paper, (0.86, 0.80, 0.62), flower(u, v, 6, 0.62))
    leaf = edge(0.16 - np.abs(u - 0.35 * np.sin(3 * v))) * edge(np.hypot(u, v) - 0.66)
    paper = mix(paper, (0.62, 0.66, 0.45), leaf)
    paper = mix(paper, (0.76, 0.33, 0.24), edge(0.13 - np.hypot(u, v)))
    return paper * (0.88 + 0.15 * noise(n, n, 3, 1.9))[..., None]


def cloth(n=768):
    """Gingham with coloured bands and a visible weave."""
    t = np.arange(n) / n
    band = edge(np.sin(2 * np.pi * 14 * t), 0.2)
    red, blue = 0.5 * (band[:, None] + band[None]), edge(np.sin(2 * np.pi * 7 * t) - 0.93, 0.1)
    colour = mix((0.93, 0.90, 0.83), (0.70, 0.16, 0.15), red)
    colour = mix(colour, (0.14, 0.22, 0.42), np.maximum(blue[:, None], blue[None]))
    weave = np.sin(2 * np.pi * 112 * t)[:, None] * np.sin(2 * np.pi * 112 * t)[None]
    return colour * (0.95 + 0.05 * weave)[..., None]


def painting(n=512):
    """Hills under an evening sky."""
    y, x = np.mgrid[0:n, 0:n] / n
    picture = mix((0.35, 0.50, 0.72), (0.98, 0.75, 0.45), np.clip(1.7 * y, 0, 1))
    picture = mix(picture, (0.98, 0.93, 0.85), 0.7 * edge(noise(n, n, 8, 1.5, 0.25).T - 0.6, 0.4) * (y < 0.5))
    picture = mix(picture, (1.0, 0.95, 0.75), edge(0.09 - np.hypot(x - 0.68, y - 0.36)))
    for i, colour in enumerate([(0.55, 0.5, 0.62), (0.42, 0.45, 0.5), (0.30, 0.42, 0.32), (0.48, 0.52, 0.2)]):
        ridge = 0.4 + 0.14 * i + (0.22 - 0.03 * i) * (noise(4, n, 20 + i, 1.3)[0] - 0.5)
        shade = np.asarray(colour) * (0.7 + 0.5 * noise(n, n, 30 + i, 1.1))[..., None]
        picture = mix(picture, shade, edge(y - ridge, 0.006))
    return picture


def globe(n=512):
    """Seas, lands and a net of meridians."""
    y, x = np.mgrid[0:n, 0:n] / n
    height = noise(n, n, 45, 1.6)
    land = mix((0.78, 0.68, 0.42), (0.36, 0.45, 0.22), noise(n, n, 46, 1.2))
    sea = mix((0.12, 0.29, 0.45), (0.35, 0.58, 0.66), edge(height - 0.5, 0.3))
    colour = mix(sea, land, edge(height - 0.58, 0.02))
    around, along = np.cos(2 * np.pi * 18 * x), np.cos(2 * np.pi * 12 * y)
    net = np.maximum(edge(around - 0.96, 0.04), edge(along - 0.97, 0.03))
    return mix(colour, (0.9, 0.86, 0.72), 0.7 * net)


def delft(n=768):
    """White glaze with blue painting, for a vase: x runs around, y from bottom to top."""
    y, x = np.mgrid[0:n, 0:n] / n
    u, v = tiles(n, n, 7, 10, 0.5)
    paint = np.maximum(flower(u, v, 8, 0.75), edge(0.1 - np.abs(v - 0.6 * np.sin(np.pi * u))))
    zigzag = edge(np.sin(2 * np.pi * 26 * x) - 2 * np.sin(2 * np.pi * 30 * y), 0.3)
    for low, high in [(0.0, 0.08), (0.30, 0.36), (0.66, 0.74), (0.94, 1.0)]:
        paint = np.where((y > low) & (y < high), zigzag, paint)
        paint = np.maximum(paint, (np.abs(y - low) < 0.008) | (np.abs(y - high) < 0.008))
    return mix((0.92, 0.92, 0.88), (0.10, 0.19, 0.52), paint * (0.7 + 0.3 * noise(n, n, 5, 1.8)))


def text(seed, n=512, lines=22, paper=(0.93, 0.90, 0.82), ink=(0.13, 0.12, 0.12)):
    """A page of marks that look like print."""
    rng, page = np.random.default_rng(seed), np.zeros((n, n))
    pitch = n // (lines + 4)
    for top in range(2 * pitch, n - 2 * pitch, pitch):
        x = n // 10
        while x < n - n // 8:
            wide = int(rng.integers(1, 8)) * 5
            page[top : top + pitch // 2, x : x + wide] = rng.uniform(size=wide) > 0.3
            x += wide + 6
    return mix(paper, ink, page)


def cover(colour, seed, n=256):
    """A book cover: cloth, a gilt frame, a title."""
    u, v = tiles(n, n, 1, 1)
    frame = edge(0.03 - np.abs(np.maximum(np.abs(u), np.abs(v)) - 0.8), 0.02)
    title = (text(seed, n, 3)[..., 0] < 0.5) * (np.abs(v) < 0.5) * (np.abs(u) < 0.65)
    linen = np.asarray(colour) * (0.75 + 0.4 * noise(n, n, seed, 0.4))[..., None]
    return mix(linen, (0.88, 0.74, 0.38), np.maximum(frame, title))


def skin(base, blush, seed, n=256):
    """Fruit skin: a blush and many small speckles."""
    speckle = edge(noise(n, n, seed, 0.3) - 0.8, 0.2)
    return mix(mix(base, blush, noise(n, n, seed + 1, 1.8)), np.asarray(base) * 0.55, 0.6 * speckle)


def marble(n=512):
    """White marble with dark veins."""
    vein = np.abs(np.sin(9 * noise(n, n, 61, 1.7) + 4 * noise(n, n, 62, 1.2))) ** 0.35
    return mix((0.30, 0.29, 0.33), (0.93, 0.91, 0.88), vein)


def dots(n=512):
    """Coloured rings on cream and a ribbon, for the parcel."""
    u, v = tiles(n, n, 6, 6)
    tile = np.arange(n) * 6 // n
    hue = (tile[:, None] + 2 * tile) % 3
    colours = np.array([(0.85, 0.33, 0.2), (0.15, 0.42, 0.45), (0.93, 0.68, 0.2)])[hue]
    wrap = mix((0.95, 0.91, 0.8), colours, edge(0.72 - np.hypot(u, v)) * edge(np.hypot(u, v) - 0.25))
    x = np.abs(np.arange(n) / n - 0.5)
    return mix(wrap, (0.75, 0.12, 0.2), edge(0.07 - np.minimum(x[:, None], x[None]), 0.01))


def leaf(n=128):
    """Green with a pale midrib and veins; x runs across the leaf, y along it."""
    u, v = tiles(n, n, 1, 1)
    vein = np.maximum(edge(0.07 - np.abs(u)), 0.6 * edge(np.sin(28 * (v - 0.8 * np.abs(u))) - 0.75, 0.2))
    return mix(mix((0.13, 0.34, 0.13), (0.28, 0.5, 0.16), noise(n, n, 71, 1.2)), (0.62, 0.74, 0.4), vein)


# Materials and shapes


def paint(colour):
    """A colour `(r, g, b)` or an image `[h, w, 3]`, sRGB, as a Mitsuba texture."""
    pixels = np.broadcast_to(np.asarray(colour, float), np.broadcast_shapes(np.shape(colour), (1, 1, 3)))
    return {"type": "bitmap", "bitmap": mi.Bitmap((255 * np.clip(pixels, 0, 1) + 0.5).astype(np.uint8))}


def matte(colour):
    """Diffuse from both sides."""
    return mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": paint(colour)}})


def glazed(colour, alpha=0.12):
    """Plastic or ceramic: diffuse under a coat of roughness `alpha`."""
    coat = {"type": "roughplastic", "diffuse_reflectance": paint(colour), "alpha": alpha}
    return mi.load_dict({"type": "twosided", "bsdf": coat})


def metal(name, alpha):
    """A named conductor, for example "Au", of roughness `alpha`."""
    return mi.load_dict({"type": "roughconductor", "material": name, "alpha": alpha})


def sphere(x, y, z, radius, bsdf, turn=0.0):
    """A ball whose textured poles point up, turned about y by `turn` degrees."""
    place = T().translate([x, y, z]).rotate([0, 1, 0], turn).rotate([1, 0, 0], -90).scale(radius)
    return {"type": "sphere", "to_world": place, "bsdf": bsdf}


def box(x, y, z, size, bsdf, turn=0.0):
    """A box of `size` (width, height, depth) standing on y, turned about y by `turn` degrees."""
    place = T().translate([x, y + size[1] / 2, z]).rotate([0, 1, 0], turn)
    return {"type": "cube", "to_world": place.scale([s / 2 for s in size]), "bsdf": bsdf}


def rod(a, b, radius, bsdf):
    """A thin cylinder from a to b."""
    return {"type": "cylinder", "p0": list(a), "p1": list(b), "radius": radius, "bsdf": bsdf}


def surface(patches, bsdf):
    """A smooth mesh through the points of `patches`, each `[h, w, 3]`; u runs along w, v along h."""
    points, uvs, faces, start = [], [], [], 0
    for p in patches:
        h, w = p.shape[:2]
        v, u = np.meshgrid(np.linspace(0, 1, h), np.linspace(0, 1, w), indexing="ij")
        i = start + np.arange(h * w).reshape(h, w)
        a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
        points.append(p.reshape(-1, 3))
        uvs.append(np.stack([u, v], -1).reshape(-1, 2))
        faces += [np.stack([a, b, d], -1), np.stack([a, d, c], -1)]
        start += h * w
    faces = np.concatenate(faces)
    props = mi.Properties()
    props["mesh_bsdf"] = bsdf
    has = {"has_vertex_normals": True, "has_vertex_texcoords": True}
    mesh = mi.Mesh("surface", start, len(faces), props=props, **has)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.concatenate(points).astype(np.float32).ravel()
    params["vertex_texcoords"] = np.concatenate(uvs).astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    return mesh


def lathe(x, y, z, profile, n=96):
    """Points `[h, n, 3]` of a profile `[(radius, height), ...]`, smoothed, turned about the vertical axis."""
    profile = np.asarray(profile, float)
    t = np.linspace(0, len(profile) - 1, 16 * len(profile))
    curve = np.stack([np.interp(t, np.arange(len(profile)), c) for c in profile.T], -1)
    for _ in range(2):
        padded = np.pad(curve, ((6, 6), (0, 0)), "reflect", reflect_type="odd")  # ends stay
        curve = np.stack([np.convolve(c, np.ones(13) / 13, "valid") for c in padded.T], -1)
    curve[:, 0] = np.maximum(curve[:, 0], 1e-3)  # a pole of no radius would have no normal
    angle = np.linspace(0, 2 * np.pi, n)
    ring = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], -1)
    return curve[:, :1, None] * ring + [x, y, z] + curve[:, 1:, None] * [0, 1, 0]


def torus(x, y, z, big, small, n=96):
    """Points `[n, n, 3]` of a flat ring of radius `big` and thickness `small`."""
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, n), np.linspace(0, 2 * np.pi, n), indexing="ij")
    r = big + small * np.cos(b)
    return np.stack([x + r * np.cos(a), y + small * np.sin(b), z + r * np.sin(a)], -1)


def blade(base, heading, length, width, rise, droop, n=24):
    """Points `[n, 3, 3]` of a leaf: from `base` it climbs at `rise` (radians) towards `heading` (degrees
    about y), then bends down by `droop`.
    """
    t = np.linspace(0, 1, n)
    out = np.array([np.sin(np.radians(heading)), 0, np.cos(np.radians(heading))])
    side = np.array([out[2], 0, -out[0]])
    height = t * np.sin(rise) - droop * t**2
    spine = base + length * (np.outer(t * np.cos(rise), out) + np.outer(height, [0, 1, 0]))
    half = width / 2 * np.sin(np.pi * (0.06 + 0.94 * t)) ** 0.8
    rim = half[:, None] * side - 0.25 * half[:, None] * [0, -1, 0]
    return np.stack([spine - rim * [1, -1, 1], spine, spine + rim], 1)


# The still life


def furniture():
    """Table, wall, painting, cloth."""
    s, t = np.meshgrid(np.linspace(-1, 1, 160), np.linspace(-1, 1, 160), indexing="ij")
    x, z = 2.1 * t + 0.12 * np.sin(3 * s), -2.3 * s
    c, d = np.cos(0.3), np.sin(0.3)
    wave = 0.035 + 0.022 * np.sin(5 * t + 2 * s) * np.sin(4 * s - t)
    runner = np.stack([c * x + d * z + 0.1, wave, c * z - d * x + 0.9], -1)
    flat = T().rotate([1, 0, 0], -90)
    hang = T().translate([1.25, 3.55, -4.35])
    gilt = glazed((0.55, 0.40, 0.16), 0.2)
    frame = {
        f"frame{i}": box(1.25 + dx, 3.55 + dy - h / 2, -4.33, (w, h, 0.18), gilt)
        for i, (dx, dy, w, h) in enumerate(
            [(0, 0.98, 2.7, 0.16), (0, -0.98, 2.7, 0.16), (-1.27, 0, 0.16, 2.1), (1.27, 0, 0.16, 2.1)]
        )
    }
    return {
        "table": {"type": "rectangle", "to_world": flat.scale([6, 6, 1]), "bsdf": glazed(wood(1), 0.3)},
        "wall": {
            "type": "rectangle",
            "to_world": T().translate([0, 4, -4.5]).scale([7, 7, 1]),
            "bsdf": matte(np.flipud(wallpaper())),
        },
        "painting": {
            "type": "rectangle",
            "to_world": hang.scale([1.25, 0.95, 1]),
            "bsdf": matte(np.flipud(painting())),
        },
        "runner": surface([runner], matte(cloth())),
        **frame,
    }


def books(x, z):
    """Three books, one upon another, a globe on top."""
    pages = matte(np.repeat(np.tile([(0.93, 0.89, 0.78), (0.7, 0.62, 0.5)], (7, 1))[None], 4, 0))
    out, y = {}, 0.0
    colours = (0.45, 0.12, 0.12), (0.12, 0.25, 0.22), (0.2, 0.2, 0.4)
    widths, thicknesses, turns = (2.0, 1.75, 1.6), (0.36, 0.3, 0.26), (8, -14, 20)
    stack = zip(colours, widths, thicknesses, turns, strict=True)
    for i, (colour, width, thick, turn) in enumerate(stack):
        board = glazed(cover(colour, 80 + i), 0.3)
        out[f"lower{i}"] = box(x, y, z, (width, 0.05, 1.4), board, turn)
        out[f"pages{i}"] = box(x, y + 0.05, z, (width - 0.12, thick, 1.3), pages, turn)
        out[f"upper{i}"] = box(x, y + 0.05 + thick, z, (width, 0.05, 1.4), board, turn)
        y += thick + 0.1
    out["stand"] = surface([torus(x, y + 0.06, z, 0.3, 0.06)], metal("Cu", 0.2))
    out["globe"] = sphere(x, y + 0.68, z, 0.62, glazed(globe(), 0.1), 40)
    return out


def bouquet(x, z):
    """A painted vase with long leaves and berries on stalks."""
    vase = [(0, 0), (0.42, 0), (0.5, 0.12), (0.78, 0.75), (0.72, 1.3), (0.3, 1.8), (0.28, 2.05), (0.42, 2.2)]
    rng, stem = np.random.default_rng(9), matte((0.35, 0.28, 0.15))
    out = {"vase": surface([lathe(x, 0, z, vase)], glazed(delft(), 0.08))}
    leaves, red = [], glazed((0.72, 0.1, 0.1), 0.15)
    for _ in range(20):
        base = np.array([x, 2.05, z]) + 0.1 * rng.normal(size=3)
        heading, length, rise = rng.uniform([0, 1.5, 0.8], [360, 2.6, 1.35])
        leaves.append(blade(base, heading, length, 0.3, rise, 0.55))
    for i in range(9):
        tip = np.array([x, 3.4, z]) + rng.uniform([-1.2, -0.4, -0.5], [1.2, 0.6, 0.7])
        out[f"stalk{i}"] = rod([x, 2.0, z], tip, 0.018, stem)
        out[f"berry{i}"] = sphere(*tip, rng.uniform(0.08, 0.13), red)
    return out | {"leaves": surface(leaves, matte(leaf()))}


def cage(x, z):
    """A wire lantern around an orange."""
    wire, out = metal("Au", 0.15), {}
    for i in range(14):
        a = 2 * np.pi * i / 14
        c, s = 0.62 * np.cos(a), 0.62 * np.sin(a)
        out[f"wire{i}"] = rod([x + c, 0.05, z + s], [x + 0.6 * c, 1.5, z + 0.6 * s], 0.022, wire)
    hoops = [torus(x, y, z, r, 0.035) for y, r in [(0.07, 0.62), (0.55, 0.54), (1.02, 0.455), (1.5, 0.372)]]
    out["hoops"] = surface(hoops, wire)
    out["orange"] = sphere(x, 0.46, z, 0.4, glazed(skin((0.93, 0.5, 0.1), (0.98, 0.66, 0.2), 90), 0.25))
    return out


def fruit():
    """Two pears and a ball of marble."""
    pear = np.array([(0, 0), (0.25, 0), (0.4, 0.25), (0.36, 0.5), (0.2, 0.75), (0.14, 0.95), (0, 1.02)])
    green = glazed(skin((0.70, 0.68, 0.22), (0.80, 0.42, 0.16), 95), 0.25)
    return {
        "pears": surface([lathe(0.95, 0.05, -0.35, pear * 1.15), lathe(1.75, 0.0, 0.15, pear)], green),
        "stem0": rod([0.95, 1.15, -0.35], [1.02, 1.4, -0.3], 0.025, matte((0.3, 0.2, 0.1))),
        "stem1": rod([1.75, 0.98, 0.15], [1.68, 1.2, 0.2], 0.025, matte((0.3, 0.2, 0.1))),
        "marble": sphere(-2.05, 0.42, 0.5, 0.42, glazed(marble(), 0.06), 70),
    }


def foreground():
    """Grass in a pot, pencils, a printed card, a parcel, the glass ball and the copper ball."""
    rng, out = np.random.default_rng(4), {}
    blades = []
    for heading in rng.uniform(0, 360, 26):
        shift, length, rise = rng.uniform([-0.15, 1.2, 0.9], [0.15, 2.2, 1.4])
        blades.append(blade([-2.0 + shift, 0.5, 2.9], heading, length, 0.1, rise, 0.5))
    out["grass"] = surface(blades, matte(leaf()))
    pot = [(0, 0), (0.25, 0), (0.27, 0.05), (0.36, 0.5), (0.4, 0.55), (0.34, 0.5), (0, 0.45)]
    out["pot"] = surface([lathe(-2.0, 0, 2.9, pot)], matte(skin((0.72, 0.38, 0.24), (0.6, 0.3, 0.2), 97)))
    for i, colour in enumerate([(0.9, 0.7, 0.1), (0.15, 0.35, 0.6), (0.75, 0.15, 0.2)]):
        a, b = (0.55 + 0.3 * i, 0.06, 3.5 - 0.1 * i), (1.75 + 0.1 * i, 0.06, 2.75 + 0.17 * i)
        out[f"pencil{i}"] = rod(a, b, 0.05, glazed(colour))
        out[f"end{i}"] = sphere(*a, 0.05, glazed(colour))
    card = T().translate([-0.75, 0.07, 2.75]).rotate([0, 1, 0], 25).rotate([1, 0, 0], -90)
    note = {"type": "rectangle", "to_world": card.scale([0.75, 0.5, 1])}
    out["card"] = note | {"bsdf": matte(np.flipud(text(77, lines=9)))}
    out["parcel"] = box(-0.95, 0.06, 0.2, (0.75, 0.75, 0.75), matte(dots()), 30)
    out["glass"] = sphere(0.15, 0.72, 1.2, 0.66, mi.load_dict({"type": "dielectric", "int_ior": 1.5}))
    out["copper"] = sphere(-1.2, 0.4, 1.55, 0.36, metal("Cu", 0.08))
    return out


def lights():
    """A large soft window above the left shoulder, and a dim room."""
    window = T().look_at(origin=[-5.5, 8, 7], target=[0, 0.8, 0], up=[0, 1, 0]).scale([5.5, 5.5, 1])
    return {
        "window": {
            "type": "rectangle",
            "to_world": window,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [2.75, 2.55, 2.25]}},
        },
        "room": {"type": "constant", "radiance": {"type": "rgb", "value": [0.42, 0.46, 0.52]}},
    }


def still_life():
    """The whole scene without a sensor, ready to render."""
    return mi.load_dict(
        {"type": "scene", "integrator": {"type": "path", "max_depth": 8, "rr_depth": 8}}
        | lights() | furniture() | books(1.75, -2.0) | bouquet(-1.45, -1.5) | cage(1.85, 1.5)
        | fruit() | foreground()
    )  # fmt: skip
