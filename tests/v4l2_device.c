/* A stand-in for cameras behind Video4Linux2, to be loaded with LD_PRELOAD.
 *
 * A path that has a file PATH.camera beside it is one. The file's lines say what it is like:
 *
 *   offers FOURCC WIDTH HEIGHT [FILE]  a format, best first, and the file of what it shows then, nothing without one
 *   rate R                             frames per second that it states
 *   fails CALL ERRNO                   this call (open, G_INPUT, S_FMT, REQBUFS, STREAMON) fails
 *   starts S                           STREAMON takes S seconds
 *   silent                             it sends nothing at the end, where it is unplugged otherwise
 *
 * FILE holds, for each frame, the seconds after the scene's beginning at which it is exposed (double), V4L2_BUF_FLAG_
 * bits and the number of bytes (uint32 each), and the bytes. The scene begins with the first STREAMON of the process,
 * for all cameras. As a driver does it, frames are dropped while no buffer is free; what is asked for and not offered
 * is answered with the first format, in the size next to it; time stamps are those of the monotonic clock.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

enum { CAMERAS = 4, FORMATS = 8, BUFFERS = 32 };

struct format {
    uint32_t fourcc, width, height;
    char file[512];
};

struct head {
    double time;
    uint32_t flags, size;
} __attribute__((packed));

struct camera {
    int fd; /* of the memory that is its buffers; -1 where this place is free */
    struct format formats[FORMATS], now;
    int offered, silent, streaming;
    double rate, starts;
    char failing[16];
    int failure;
    uint8_t *frames, *next, *end; /* what it shows */
    uint8_t *memory;
    uint32_t length; /* of a buffer */
    int queued[BUFFERS], waiting, filled[BUFFERS], done;
    struct v4l2_buffer state[BUFFERS];
    uint32_t sequence;
};

static struct camera cameras[CAMERAS] = {{.fd = -1}, {.fd = -1}, {.fd = -1}, {.fd = -1}};
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static double begun; /* of the scene */

static double monotonic(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

static void wait_for(double seconds)
{
    struct timespec time = {(time_t)seconds, (long)(1e9 * (seconds - (time_t)seconds))};
    if (seconds > 0)
        nanosleep(&time, NULL);
}

static struct camera *camera_of(int fd)
{
    for (int i = 0; i < CAMERAS; i++)
        if (fd >= 0 && cameras[i].fd == fd)
            return &cameras[i];
    return NULL;
}

static uint32_t size_of(const struct format *f)
{
    uint32_t area = f->width * f->height;
    return f->fourcc == V4L2_PIX_FMT_GREY ? area : 2 * area;
}

static int fails(const struct camera *c, const char *call)
{
    if (strcmp(c->failing, call))
        return 0;
    errno = c->failure;
    return 1;
}

static void read_description(struct camera *c, FILE *from)
{
    char line[1024], name[16], word[512];
    while (fgets(line, sizeof line, from)) {
        struct format *f = &c->formats[c->offered];
        word[0] = 0;
        int found = sscanf(line, "offers %4c %u %u %511s", name, &f->width, &f->height, word);
        if (found >= 3 && c->offered + 1 < FORMATS) {
            f->fourcc = v4l2_fourcc(name[0], name[1], name[2], name[3]);
            strcpy(f->file, word);
            c->offered++;
        }
        sscanf(line, "rate %lf", &c->rate);
        sscanf(line, "starts %lf", &c->starts);
        sscanf(line, "fails %15s %d", c->failing, &c->failure);
        c->silent |= !strncmp(line, "silent", 6);
    }
    c->now = c->formats[0];
}

static int open_camera(FILE *description)
{
    struct camera *c = NULL;
    for (int i = 0; i < CAMERAS && !c; i++)
        if (cameras[i].fd < 0)
            c = &cameras[i];
    if (!c) {
        errno = EMFILE;
        return -1;
    }
    *c = (struct camera){.fd = -1};
    read_description(c, description);
    return fails(c, "open") ? -1 : (c->fd = memfd_create("camera", MFD_CLOEXEC));
}

int open64(const char *path, int flags, ...)
{
    static int (*next)(const char *, int, ...);
    char description[4096];
    va_list more;
    va_start(more, flags);
    int mode = va_arg(more, int);
    va_end(more);
    if (!next)
        *(void **)&next = dlsym(RTLD_NEXT, "open64");
    snprintf(description, sizeof description, "%s.camera", path);
    int file = next(description, O_RDONLY);
    if (file < 0)
        return next(path, flags, mode);
    FILE *stream = fdopen(file, "r");
    pthread_mutex_lock(&lock);
    int fd = open_camera(stream);
    int error = errno;
    pthread_mutex_unlock(&lock);
    fclose(stream);
    errno = error;
    return fd;
}

static int set_format(struct camera *c, struct v4l2_pix_format *asked)
{
    const struct format *best = NULL;
    uint32_t fourcc = c->formats[0].fourcc;
    for (int i = 0; i < c->offered; i++)
        if (c->formats[i].fourcc == asked->pixelformat)
            fourcc = asked->pixelformat;
    for (int i = 0; i < c->offered; i++) {
        const struct format *f = &c->formats[i];
#define FAR(f) (abs((int)(f)->width - (int)asked->width) + abs((int)(f)->height - (int)asked->height))
        if (f->fourcc == fourcc && (!best || FAR(f) < FAR(best)))
            best = f;
    }
    c->now = *best;
    asked->width = best->width;
    asked->height = best->height;
    asked->pixelformat = best->fourcc;
    asked->field = V4L2_FIELD_NONE;
    asked->sizeimage = size_of(best);
    return 0;
}

static int make_buffers(struct camera *c, struct v4l2_requestbuffers *asked)
{
    if (asked->count > BUFFERS)
        asked->count = BUFFERS;
    c->length = (size_of(&c->now) + 4095) & ~4095u;
    if (ftruncate(c->fd, (off_t)c->length * asked->count))
        return -1;
    c->memory = mmap(NULL, (size_t)c->length * asked->count, PROT_READ | PROT_WRITE, MAP_SHARED, c->fd, 0);
    return c->memory == MAP_FAILED ? -1 : 0;
}

static int begin(struct camera *c)
{
    struct stat about;
    FILE *file = c->now.file[0] ? fopen(c->now.file, "r") : NULL;
    if (file) {
        if (!fstat(fileno(file), &about) && about.st_size) {
            c->next = c->frames = mmap(NULL, about.st_size, PROT_READ, MAP_PRIVATE, fileno(file), 0);
            c->end = c->frames + about.st_size;
        }
        fclose(file);
    }
    if (begun == 0)
        begun = monotonic();
    wait_for(c->starts);
    for (struct head h; c->next < c->end; c->next += sizeof h + h.size) { /* what was before it looked */
        memcpy(&h, c->next, sizeof h);
        if (c->starts == 0 || begun + h.time >= monotonic())
            break;
    }
    c->streaming = 1;
    return 0;
}

/* Fills buffers with what has been exposed by now; returns when there will be more, 0 for never. */
static double expose(struct camera *c)
{
    struct head h;
    while (c->next < c->end) {
        memcpy(&h, c->next, sizeof h);
        if (begun + h.time > monotonic())
            return begun + h.time;
        if (c->waiting) {
            int i = c->queued[0];
            memmove(c->queued, c->queued + 1, --c->waiting * sizeof *c->queued);
            memcpy(c->memory + (size_t)i * c->length, c->next + sizeof h, h.size);
            int64_t stamp = (int64_t)(1e6 * (begun + h.time));
            c->state[i] = (struct v4l2_buffer){
                .index = i, .type = V4L2_BUF_TYPE_VIDEO_CAPTURE, .memory = V4L2_MEMORY_MMAP, .bytesused = h.size,
                .flags = h.flags | V4L2_BUF_FLAG_MAPPED | V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, .sequence = c->sequence,
                .timestamp = {stamp / 1000000, stamp % 1000000}, .length = c->length};
            c->filled[c->done++] = i;
        }
        c->sequence++;
        c->next += sizeof h + h.size;
    }
    return 0;
}

static int take(struct camera *c, struct v4l2_buffer *buffer)
{
    for (;;) {
        double more = expose(c);
        if (c->done) {
            *buffer = c->state[c->filled[0]];
            memmove(c->filled, c->filled + 1, --c->done * sizeof *c->filled);
            return 0;
        }
        if (!more && !c->silent) {
            errno = ENODEV;
            return -1;
        }
        pthread_mutex_unlock(&lock);
        wait_for(more ? more - monotonic() : 0.1);
        pthread_mutex_lock(&lock);
    }
}

static int answer(struct camera *c, unsigned long request, void *with)
{
    switch (request) {
    case VIDIOC_QUERYCAP: {
        uint32_t does = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
        *(struct v4l2_capability *)with = (struct v4l2_capability){
            .driver = "stand-in", .card = "stand-in", .capabilities = does | V4L2_CAP_DEVICE_CAPS, .device_caps = does};
        return 0;
    }
    case VIDIOC_G_INPUT:
        if (fails(c, "G_INPUT"))
            return -1;
        *(int *)with = 0;
        return 0;
    case VIDIOC_ENUMINPUT:
        *(struct v4l2_input *)with = (struct v4l2_input){.name = "Camera 1", .type = V4L2_INPUT_TYPE_CAMERA};
        return 0;
    case VIDIOC_S_FMT:
        return fails(c, "S_FMT") ? -1 : set_format(c, &((struct v4l2_format *)with)->fmt.pix);
    case VIDIOC_G_PARM: {
        struct v4l2_captureparm *p = &((struct v4l2_streamparm *)with)->parm.capture;
        p->capability = V4L2_CAP_TIMEPERFRAME;
        p->timeperframe = (struct v4l2_fract){1000, (uint32_t)(1000 * c->rate + 0.5)};
        return 0;
    }
    case VIDIOC_REQBUFS:
        return fails(c, "REQBUFS") ? -1 : make_buffers(c, with);
    case VIDIOC_QUERYBUF: {
        struct v4l2_buffer *b = with;
        b->length = c->length;
        b->m.offset = b->index * c->length;
        return 0;
    }
    case VIDIOC_QBUF:
        if (c->streaming)
            expose(c); /* what came while it was not free is dropped */
        c->queued[c->waiting++] = ((struct v4l2_buffer *)with)->index;
        return 0;
    case VIDIOC_DQBUF:
        return take(c, with);
    case VIDIOC_STREAMON:
        return fails(c, "STREAMON") ? -1 : begin(c);
    case VIDIOC_STREAMOFF:
        c->streaming = 0;
        return 0;
    default: /* as VIDIOC_G_STD */
        errno = ENOTTY;
        return -1;
    }
}

int ioctl(int fd, unsigned long request, ...)
{
    static int (*next)(int, unsigned long, ...);
    va_list more;
    va_start(more, request);
    void *with = va_arg(more, void *);
    va_end(more);
    pthread_mutex_lock(&lock);
    struct camera *c = camera_of(fd);
    int result = c ? answer(c, request, with) : 0;
    int error = errno;
    pthread_mutex_unlock(&lock);
    errno = error;
    if (c)
        return result;
    if (!next)
        *(void **)&next = dlsym(RTLD_NEXT, "ioctl");
    return next(fd, request, with);
}

int close(int fd)
{
    static int (*next)(int);
    pthread_mutex_lock(&lock);
    struct camera *c = camera_of(fd);
    if (c)
        c->fd = -1;
    pthread_mutex_unlock(&lock);
    if (!next)
        *(void **)&next = dlsym(RTLD_NEXT, "close");
    return next(fd);
}
