"""Projections straight from the papers and from the programs' own documentation, one point at a time. They share
nothing with pipefish.lenses, whose oracle they are. All in our frame and with pixel centres at integers."""

from __future__ import annotations

from math import atan, atan2, cos, hypot, sin, sqrt, tan

from numpy import roots


def brown(x, y, k, p, s=(0, 0, 0, 0)):
    """OpenCV, calib3d: k1..k6, p1 p2, s1..s4."""
    k1, k2, k3, k4, k5, k6 = (*k, *(0,) * (6 - len(k)))
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    xd = x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x) + s[0] * r2 + s[1] * r2 * r2
    yd = y * radial + p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y + s[2] * r2 + s[3] * r2 * r2
    return xd, yd


def pinhole(f, c, k=(), p=(0, 0)):
    def project(x, y, z):
        a, b = brown(x / z, y / z, k, p)
        return f[0] * a + c[0], f[1] * b + c[1]

    return project


def fisheye(f, c, k, skew=0.0):
    """OpenCV's fisheye page, with atan2 so that it goes beyond 90 degrees."""

    def project(x, y, z):
        r = hypot(x, y)
        t = atan2(r, z)
        d = t + sum(ki * t ** (2 * i + 3) for i, ki in enumerate(k))
        a, b = (d * x / r, d * y / r) if r else (0, 0)
        return f[0] * a + skew * b + c[0], f[1] * b + c[1]

    return project


def mei(xi, f, c, k=(), p=(0, 0), skew=0.0):
    def project(x, y, z):
        n = sqrt(x * x + y * y + z * z)
        a, b = brown(x / n / (z / n + xi), y / n / (z / n + xi), k, p)
        return f[0] * a + skew * b + c[0], f[1] * b + c[1]

    return project


def double_sphere(xi, alpha, f, c):
    """Usenko et al., equations 40 to 42."""

    def project(x, y, z):
        d1 = sqrt(x * x + y * y + z * z)
        d2 = sqrt(x * x + y * y + (xi * d1 + z) ** 2)
        w = alpha * d2 + (1 - alpha) * (xi * d1 + z)
        return f[0] * x / w + c[0], f[1] * y / w + c[1]

    return project


def eucm(alpha, beta, f, c):
    def project(x, y, z):
        w = alpha * sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
        return f[0] * x / w + c[0], f[1] * y / w + c[1]

    return project


def fov(omega, f, c):
    """Devernay and Faugeras, equation 13."""

    def project(x, y, z):
        ru = hypot(x / z, y / z)
        rd = atan(2 * ru * tan(omega / 2)) / omega
        s = rd / ru if ru else 2 * tan(omega / 2) / omega
        return f[0] * s * x / z + c[0], f[1] * s * y / z + c[1]

    return project


def stereographic(f, c):
    def project(x, y, z):
        n = sqrt(x * x + y * y + z * z)
        return 2 * f[0] * x / (n + z) + c[0], 2 * f[1] * y / (n + z) + c[1]

    return project


def ocam_toolbox(ss, row_column_centre, c, d, e):
    """Scaramuzza's world2cam by its definition: x runs down the rows, y along the columns, the camera looks along -z;
    the sensor point is lambda (u, v, ss(rho)). Returns (column, row)."""

    def project(x, y, z):
        X, Y, Z = y, x, -z  # into the toolbox's frame: rows, columns, backwards
        n = hypot(X, Y)
        if n == 0:
            return row_column_centre[1], row_column_centre[0]
        slope = Z / n
        p = list(ss)
        p[1] -= slope
        rho = min(r.real for r in roots(p[::-1]) if abs(r.imag) < 1e-9 and r.real > 0)
        u, v = X / n * rho, Y / n * rho
        row, column = c * u + d * v + row_column_centre[0], e * u + v + row_column_centre[1]
        return column, row

    return project


def py_ocam(taylor, centre, stretch):
    """py-OCamCalib: x along the columns, z forward, stretch on (x, y)."""

    def project(x, y, z):
        n = hypot(x, y)
        if n == 0:
            return centre
        p = list(taylor)
        p[1] -= z / n
        rho = min(r.real for r in roots(p[::-1]) if abs(r.imag) < 1e-9 and r.real > 0)
        a, b = x / n * rho, y / n * rho
        return (
            stretch[0][0] * a + stretch[0][1] * b + centre[0],
            stretch[1][0] * a + stretch[1][1] * b + centre[1],
        )

    return project


def woodscape(k, aspect, centre):
    def project(x, y, z):
        r = hypot(x, y)
        t = atan2(r, z)
        rho = sum(ki * t ** (i + 1) for i, ki in enumerate(k))
        return (rho * x / r if r else 0) + centre[0], (rho * y / r * aspect if r else 0) + centre[1]

    return project


def kannala_brandt(k, m, centre, radial=None, tangential=None):
    """Paper II, equations 6 to 13: radial = (theta coefficients, phi coefficients)."""

    def project(x, y, z):
        t, phi = atan2(hypot(x, y), z), atan2(y, x)
        wave = (cos(phi), sin(phi), cos(2 * phi), sin(2 * phi))

        def term(part):
            if part is None:
                return 0.0
            a, b = part
            return (a[0] * t + a[1] * t**3 + a[2] * t**5) * sum(bi * w for bi, w in zip(b, wave, strict=True))

        r = sum(ki * t ** (2 * i + 1) for i, ki in enumerate(k)) + term(radial)
        s = term(tangential)
        xd, yd = r * cos(phi) - s * sin(phi), r * sin(phi) + s * cos(phi)
        return m[0] * xd + centre[0], m[1] * yd + centre[1]

    return project


def colmap_thin_prism(f, c, k, p, s):
    def project(x, y, z):
        r = hypot(x, y)
        t = atan2(r, z)
        a, b = (t * x / r, t * y / r) if r else (0, 0)
        q = a * a + b * b
        radial = 1 + k[0] * q + k[1] * q**2 + k[2] * q**3 + k[3] * q**4
        u = a * radial + 2 * p[0] * a * b + p[1] * (q + 2 * a * a) + s[0] * q
        v = b * radial + p[0] * (q + 2 * b * b) + 2 * p[1] * a * b + s[1] * q
        return f[0] * u + c[0], f[1] * v + c[1]

    return project
