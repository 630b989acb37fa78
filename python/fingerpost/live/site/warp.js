// Homographies between four points, as CSS transforms.

// from, to: four points [x, y] each. Null if three of either are collinear.
export function homography(from, to) {
  const rows = from.flatMap(([x, y], k) => {
    const [u, v] = to[k];
    return [
      [x, y, 1, 0, 0, 0, -u * x, -u * y, u],
      [0, 0, 0, x, y, 1, -v * x, -v * y, v],
    ];
  });
  const h = solved(rows);
  return h && [...h, 1];
}

// Gaussian elimination with pivoting; the last column is the right-hand side.
function solved(rows) {
  const count = rows.length;
  for (let k = 0; k < count; k++) {
    const best = rows.slice(k).reduce((a, row, i) => (Math.abs(row[k]) > Math.abs(rows[a][k]) ? k + i : a), k);
    [rows[k], rows[best]] = [rows[best], rows[k]];
    if (Math.abs(rows[k][k]) < 1e-9) return null;
    for (let i = 0; i < count; i++) {
      if (i === k) continue;
      const share = rows[i][k] / rows[k][k];
      for (let j = k; j <= count; j++) rows[i][j] -= share * rows[k][j];
    }
  }
  return rows.map((row, k) => row[count] / row[k]);
}

// The 4 × 4 matrix in column order, with depth unchanged.
export function matrix3d([a, b, c, d, e, f, g, h, i]) {
  return `matrix3d(${[a, d, 0, g, b, e, 0, h, 0, 0, 1, 0, c, f, 0, i].join()})`;
}

// Whether four points in order form a convex quadrilateral.
export function isConvex(points) {
  const turns = points.map(([x, y], k) => {
    const [u, v] = points[(k + 1) % 4];
    const [s, t] = points[(k + 2) % 4];
    return (u - x) * (t - v) - (v - y) * (s - u);
  });
  return turns.every((turn) => turn > 1) || turns.every((turn) => turn < -1);
}
