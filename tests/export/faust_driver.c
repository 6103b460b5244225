/* Runs a Faust program of controls without a sound card, for Faust's C back end.

   Arguments: sample rate, samples, then for each blow contact, force, contact time and the sample at which the gate
   opens, a multiple of the block. Writes the samples to the standard output, as doubles. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define FAUSTFLOAT REAL
#define BLOCK 64

typedef void (*Box)(void *, const char *);
typedef void (*Button)(void *, const char *, FAUSTFLOAT *);
typedef void (*Slider)(void *, const char *, FAUSTFLOAT *, FAUSTFLOAT, FAUSTFLOAT, FAUSTFLOAT, FAUSTFLOAT);
typedef void (*Bar)(void *, const char *, FAUSTFLOAT *, FAUSTFLOAT, FAUSTFLOAT);

/* The members' names are those that Faust's C back end calls; their order is free. */
typedef struct {
    void *uiInterface;
    Box openTabBox, openHorizontalBox, openVerticalBox;
    void (*closeBox)(void *);
    Button addButton, addCheckButton;
    Slider addVerticalSlider, addHorizontalSlider, addNumEntry;
    Bar addHorizontalBargraph, addVerticalBargraph;
    void (*addSoundfile)(void *, const char *, const char *, void **);
    void (*declare)(void *, FAUSTFLOAT *, const char *, const char *);
} UIGlue;

typedef struct {
    void *metaInterface;
    void (*declare)(void *, const char *, const char *);
} MetaGlue;

#define min(a, b) ((a) < (b) ? (a) : (b))
#define max(a, b) ((a) < (b) ? (b) : (a))

<<includeIntrinsic>>
<<includeclass>>

static struct {
    const char *name;
    FAUSTFLOAT *place;
} controls[16];
static int known = 0;

static void add(void *ui, const char *name, FAUSTFLOAT *place) {
    controls[known].name = name;
    controls[known++].place = place;
}
static void slider(void *ui, const char *name, FAUSTFLOAT *place, FAUSTFLOAT start, FAUSTFLOAT low, FAUSTFLOAT high,
                   FAUSTFLOAT step) {
    add(ui, name, place);
}
static void box(void *ui, const char *name) {}
static void close_box(void *ui) {}
static void declare(void *ui, FAUSTFLOAT *place, const char *key, const char *value) {}

static void set(const char *name, double value) {
    for (int i = 0; i < known; i++)
        if (!strcmp(controls[i].name, name)) *controls[i].place = value;
}

int main(int count, char **words) {
    int rate = atoi(words[1]), samples = atoi(words[2]);
    mydsp *dsp = newmydsp();
    UIGlue ui = {.openTabBox = box,
                 .openHorizontalBox = box,
                 .openVerticalBox = box,
                 .closeBox = close_box,
                 .addButton = add,
                 .addNumEntry = slider,
                 .addHorizontalSlider = slider,
                 .declare = declare};
    FAUSTFLOAT out[BLOCK], *outputs[1] = {out};
    initmydsp(dsp, rate);
    buildUserInterfacemydsp(dsp, &ui);
    for (int done = 0; done < samples; done += BLOCK) {
        int length = min(BLOCK, samples - done);
        double gate = 0;
        for (int i = 3; i + 3 < count; i += 4)
            if (atoi(words[i + 3]) == done) {
                set("contact", atof(words[i]));
                set("force", atof(words[i + 1]));
                set("contactTime", atof(words[i + 2]));
                gate = 1;
            }
        set("gate", gate);
        computemydsp(dsp, length, NULL, outputs);
        for (int i = 0; i < length; i++) {
            double value = out[i];
            fwrite(&value, sizeof value, 1, stdout);
        }
    }
    return 0;
}
