"""The geometry of one particle's regions, in plain Python that a compiler for any device takes.

`quadrilaterals_cpu` and `patch_features_cpu` compile it with ``numba.njit``, `cuda.motion` with
``numba.cuda.jit(device=True)``.
"""

# mypy: allow-untyped-defs
from __future__ import annotations


def transfer(quad, R, shift, plane, K, K_inv, transferred):
    """(11) of [Zhu]: vertices (4, 2) through the homography K (ΔR + Δt nᵀ/d) K⁻¹ of (5), into ``transferred`` (4, 2).

    ``R`` ΔR (3, 3), ``shift`` Δt (3,), ``plane`` n/d (3,). The homography is not written out as a matrix: n/d enters
    as one inner product with the ray of a vertex.
    """
    for v in range(4):
        x, y = quad[v, 0], quad[v, 1]
        a = K_inv[0, 0] * x + K_inv[0, 1] * y + K_inv[0, 2]
        b = K_inv[1, 0] * x + K_inv[1, 1] * y + K_inv[1, 2]
        c = K_inv[2, 0] * x + K_inv[2, 1] * y + K_inv[2, 2]
        share = plane[0] * a + plane[1] * b + plane[2] * c
        X = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + share * shift[0]
        Y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + share * shift[1]
        Z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + share * shift[2]
        w = K[2, 0] * X + K[2, 1] * Y + K[2, 2] * Z
        transferred[v, 0] = (K[0, 0] * X + K[0, 1] * Y + K[0, 2] * Z) / w
        transferred[v, 1] = (K[1, 0] * X + K[1, 1] * Y + K[1, 2] * Z) / w


def cross_diagonals(q, crossing):
    """Writes the intersection of the diagonals of the region ``q`` (4, 2) into ``crossing`` (2,)."""
    ac_x, ac_y = q[2, 0] - q[0, 0], q[2, 1] - q[0, 1]
    bd_x, bd_y = q[3, 0] - q[1, 0], q[3, 1] - q[1, 1]
    ab_x, ab_y = q[1, 0] - q[0, 0], q[1, 1] - q[0, 1]
    share = (ab_x * bd_y - ab_y * bd_x) / (ac_x * bd_y - ac_y * bd_x)
    crossing[0] = q[0, 0] + share * ac_x
    crossing[1] = q[0, 1] + share * ac_y


def unit_square_to(q, H):
    """Into ``H`` (3, 3) the homography of the unit square's corners tl, tr, br, bl to the region ``q`` (4, 2)."""
    a, b, c, d = q[0], q[1], q[2], q[3]
    sx, sy = a[0] - b[0] + c[0] - d[0], a[1] - b[1] + c[1] - d[1]
    ex, ey = b[0] - c[0], b[1] - c[1]
    fx, fy = d[0] - c[0], d[1] - c[1]
    det = ex * fy - fx * ey
    g, h = (sx * fy - fx * sy) / det, (ex * sy - sx * ey) / det
    for i in range(2):
        H[i, 0] = b[i] - a[i] + g * b[i]
        H[i, 1] = d[i] - a[i] + h * d[i]
        H[i, 2] = a[i]
    H[2, 0], H[2, 1], H[2, 2] = g, h, 1.0


def inward_edges(q, edges):
    """Into ``edges`` (4, 3) the lines along the sides of the region ``q`` (4, 2), tl, tr, br, bl, positive inside."""
    for i in range(4):
        x, y = q[i, 0], q[i, 1]
        across, down = q[(i + 1) % 4, 0] - x, q[(i + 1) % 4, 1] - y
        edges[i, 0], edges[i, 1], edges[i, 2] = -down, across, down * x - across * y
