// Moving edges of ViSP (Bouthemy 1989) on two lines, the flanks of a finger, in every view.
//
//     visp_moving_edges TIP_U TIP_V ANGLE_DEG LENGTH_PX [the same for the next view ...]
//
// Standard input: for each image a view's number, a width and a height (32 bits each), then its
// pixels, blue, green, red. Standard output: ViSP's version, then a line per image, first the
// processor time in seconds spent so far, without that for reading and writing, then two points
// u0 v0 u1 v1 of the line midway between the flanks; none when a flank has too few moving edges for
// ViSP.
//
// The settings are those of least RMS on the built-in clip among 64: ranges of 4 to 15 px, steps of
// 1 to 5 px and thresholds of 1000 to 15000. Two other uses of moving edges were tried there: kept
// to the finger's length behind the foremost one, they were lost in half of the frames or farther
// off; the outline of a finger in vpMbEdgeTracker was farther off in all settings.

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <iostream>
#include <memory>
#include <vector>

#include <visp3/core/vpImageConvert.h>
#include <visp3/me/vpMeLine.h>

namespace {

constexpr unsigned RANGE_PX = 15;
constexpr double STEP_PX = 2.0, THRESHOLD = 1000.0;

// In visible lengths of a usual finger: half its width, and how far behind the tip the lines begin
// and end; the flanks curve before, and behind is the hand.
constexpr double HALF_WIDTH = 0.115, FRONT = 0.2, BACK = 0.8;

struct Start {
  double u, v, angle_deg, length_px;
};

class Flank {
public:
  Flank(const Start &start, double side)
      : back_(at(start, BACK, side)), front_(at(start, FRONT, side)) {}

  // Follow the flank into an image, or search it where it was last; say whether it was found.
  bool follow(const vpImage<unsigned char> &image, vpMe &settings) {
    try {
      if (line_) {
        line_->track(image);
      } else {
        line_.reset(new vpMeLine);
        line_->setMe(&settings);
        line_->initTracking(image, back_, front_);
      }
      line_->getExtremities(back_, front_);
    } catch (const vpException &) {
      line_.reset();
    }
    return line_ != nullptr;
  }

  // Return a, b, c of the line a v + b u + c = 0.
  std::vector<double> line() const { return {line_->getA(), line_->getB(), line_->getC()}; }

  vpImagePoint middle() const { return (back_ + front_) / 2.0; }

private:
  static vpImagePoint at(const Start &start, double behind, double side) {
    const double angle = vpMath::rad(start.angle_deg);
    const double u = behind * std::cos(angle) + side * std::sin(angle);
    const double v = behind * std::sin(angle) - side * std::cos(angle);
    return {start.v - start.length_px * v, start.u - start.length_px * u};
  }

  vpImagePoint back_, front_;
  std::unique_ptr<vpMeLine> line_;
};

class View {
public:
  explicit View(const Start &start) : left_(start, -HALF_WIDTH), right_(start, HALF_WIDTH) {
    settings_.setRange(RANGE_PX);
    settings_.setSampleStep(STEP_PX);
    settings_.setThreshold(THRESHOLD);
  }

  bool follow(const vpImage<unsigned char> &image) {
    const bool left = left_.follow(image, settings_);
    return right_.follow(image, settings_) && left;
  }

  // Print two points of the line midway between the flanks, whose normals are made to agree.
  void print() const {
    const std::vector<double> p = left_.line(), q = right_.line();
    const double sign = p[0] * q[0] + p[1] * q[1] < 0.0 ? -1.0 : 1.0;
    const double norm = std::hypot(p[0] + sign * q[0], p[1] + sign * q[1]);
    const double a = (p[0] + sign * q[0]) / norm, b = (p[1] + sign * q[1]) / norm;
    const double c = (p[2] + sign * q[2]) / norm;
    const vpImagePoint near = (left_.middle() + right_.middle()) / 2.0;
    const double off = a * near.get_i() + b * near.get_j() + c;
    const double u = near.get_j() - off * b, v = near.get_i() - off * a;
    std::printf(" %.6f %.6f %.6f %.6f", u, v, u + a * LINE_PX, v - b * LINE_PX);
  }

private:
  static constexpr double LINE_PX = 20.0; // between the two points

  vpMe settings_;
  Flank left_, right_;
};

bool read(void *to, std::size_t bytes) {
  return bool(std::cin.read(static_cast<char *>(to), std::streamsize(bytes)));
}

} // namespace

int main(int count, char **words) {
  std::vector<std::unique_ptr<View>> views; // their lines keep the address of their settings
  auto number = [&](int word) { return std::strtod(words[word], nullptr); };
  for (int k = 1; k + 3 < count; k += 4)
    views.emplace_back(new View({number(k), number(k + 1), number(k + 2), number(k + 3)}));
  std::printf("ViSP %d.%d.%d\n", VISP_VERSION_MAJOR, VISP_VERSION_MINOR, VISP_VERSION_PATCH);
  std::fflush(stdout);
  std::clock_t spent = 0; // of all threads
  std::uint32_t head[3];
  std::vector<unsigned char> pixels;
  while (read(head, sizeof head)) {
    View &view = *views.at(head[0]);
    const unsigned width = head[1], height = head[2];
    pixels.resize(std::size_t(3) * width * height);
    if (!read(pixels.data(), pixels.size()))
      return EXIT_FAILURE;
    const std::clock_t begun = std::clock();
    vpImage<unsigned char> grey(height, width);
    // One thread: those of OpenMP would wait for the next image at full load.
    vpImageConvert::BGRToGrey(pixels.data(), grey.bitmap, width, height, false, 1);
    const bool found = view.follow(grey);
    spent += std::clock() - begun;
    std::printf("%.6f", double(spent) / CLOCKS_PER_SEC);
    if (found)
      view.print();
    std::printf("\n");
    std::fflush(stdout);
  }
}
